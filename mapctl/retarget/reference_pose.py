"""The T-pose of any rig: the rotation of each joint in it, from a table, or found from a pose that is near it.

All rotations zero, or a clip's first frame, is the pose to begin from. It is rotated upright and to face +Z; then each
limb is laid along its canonical direction by the shortest arc, from the body outward. Feet keep their orientation.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.retarget.pose_axes import RigPoses, find_up_axis, unit_vectors
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT

_LIMBS = ("UpperArm", "LowerArm", "UpperLeg", "LowerLeg")
_SNAP = math.radians(20)  # a rest pose whose up or facing is this near an axis has it along that axis
_TRUNK_TOLERANCE = math.radians(40)  # trunk and shoulders keep their own shape up to here
# Of arms below level: a T-pose up to the first, an A-pose up to the second.
_LEVEL, _HANGING = math.radians(25), math.radians(100)
_LEG_TOLERANCE = math.radians(35)  # between the legs of a standing rest pose and the vertical
_EXACT_TPOSE_ANGLE = math.radians(15)  # of arms and legs in a frame that is a T-pose on purpose
_MIN_HINGE_BEND = 0.2  # radians: least mean bend of a joint from which its hinge axis is estimated
_MIN_TWIST = math.radians(60)  # least twist that is corrected
_QUARTER_TURN = math.pi / 2  # rigs are built in quarter turns
_VECTORS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True, eq=False)
class TPose:
    """The pose of the rig that corresponds to the canonical skeleton's rest pose."""

    quat_xyzw: Float[Tensor, "joints 4"]
    """World rotation of each canonical joint's rig joint, in a world with Y up."""
    idle_quat_xyzw: Float[Tensor, "rigged 4"]
    """Local rotations of the rig's joints at rest, used for joints without a canonical counterpart."""
    upright_quat_xyzw: Float[Tensor, "4"] | None
    """Rotation that takes the file's world to Y up, xyzw; None where it is."""
    up: str
    """Axis of the file's world that points up."""
    facing: str
    """Axis of the file that the rest pose faces; `unknown` where it faces along none."""
    rest: str
    """What the pose with all rotations zero is: T, A or neither."""
    found: str
    """Where the T-pose comes from: table, rest pose, or frame 0."""


def find_tpose(zero: RigPoses, clip: RigPoses | None, *, rig: Rig) -> TPose:
    """Find the T-pose of a rig whose table has none; axes that the rig sets are taken, not searched for."""
    up = find_up_axis(zero, clip) if rig.up == "auto" else rig.up
    upright = upright_rotation(up)
    base, found, facing = zero, "rest pose", None if rig.facing == "auto" else axis_vector(rig.facing)
    front = _facing_rotation(zero, facing)
    rest = classify_reference_pose(zero, front)
    if clip is not None and rig.rest in ("auto", "frame0"):
        first = clip.first()
        turned = _first_frame_rotation(first, axis_vector(up))
        if rig.rest == "frame0" or (rest == "neither" and is_tpose(first, turned)):
            base, front, found = first, turned, "frame 0"
    stands = classify_reference_pose(base, front) != "neither"
    if clip is None or stands:
        quats = _lay_out_tpose(base, front, stands, pitch=None, twists={})
    else:
        quats = _untwist_tpose(base, front, clip, upright)
    return TPose(
        quats, _local_rotations(base), upright, up, nearest_axis_name(_facing_rotation(zero, facing)[2]), rest, found
    )


def classify_reference_pose(poses: RigPoses, front: Float[Tensor, "3 3"]) -> str:
    """Classify the first pose as a T-pose, an A-pose (arms anywhere between level and hanging), or neither.

    `front` rotates it to be upright and face +Z.
    """
    arms = [
        (_bone_direction(poses, side + part, front), sign)
        for side, sign in (("left", 1.0), ("right", -1.0))
        for part in ("UpperArm", "LowerArm")
    ]
    legs = [
        _bone_direction(poses, side + part, front) for side in ("left", "right") for part in ("UpperLeg", "LowerLeg")
    ]
    if any(float(-leg[1]) < math.cos(_LEG_TOLERANCE) for leg in legs):
        return "neither"
    arms = [(arm, sign) for arm, sign in arms if float(arm.norm()) > 0]
    lowered = [math.atan2(-float(arm[1]), max(sign * float(arm[0]), -0.2)) for arm, sign in arms]
    if any(abs(float(arm[2])) > 0.6 for arm, _ in arms) or not all(-_LEVEL < low < _HANGING for low in lowered):
        return "neither"
    return "T" if max(lowered) < _LEVEL else "A"


def upright_rotation(up: str) -> Float[Tensor, "4"] | None:
    """Return the rotation from a world with this up axis to one with Y up; None where it is Y already."""
    return None if up == "y" else rotations.from_matrix(align_bone(axis_vector(up), axis_vector("y")))


def is_tpose(poses: RigPoses, front: Float[Tensor, "3 3"]) -> bool:
    """Return whether the first pose is a T-pose that captures begin with: all straight, arms level, legs vertical."""
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for part, aim in (("Arm", axis_vector("x") * sign), ("Leg", -axis_vector("y"))):
            bones = [_bone_direction(poses, f"{side}{half}{part}", front) for half in ("Upper", "Lower")]
            if any(float(bone @ aim) < math.cos(_EXACT_TPOSE_ANGLE) for bone in bones):
                return False
    return True


def axis_vector(axis: str) -> Float[Tensor, "3"]:
    """Return the vector of an axis by name, as `-z`."""
    return torch.tensor(_VECTORS[axis[-1]], dtype=torch.float64) * (-1 if axis.startswith("-") else 1)


def find_rest_facing(zero: RigPoses) -> str:
    """Find the axis that the pose with all rotations zero faces; `unknown` if it is along none."""
    return nearest_axis_name(_facing_rotation(zero, None)[2])


def nearest_axis_name(direction: Float[Tensor, "3"]) -> str:
    """Return the axis that a unit vector points along; `unknown` if it is none."""
    largest = int(direction.abs().argmax())
    if float(direction[largest].abs()) < math.cos(_SNAP):
        return "unknown"
    return ("-" if float(direction[largest]) < 0 else "") + "xyz"[largest]


def _facing_rotation(zero: RigPoses, facing: Tensor | None) -> Float[Tensor, "3 3"]:
    """Return the rotation of the zero pose to upright, facing +Z; its rows are where left, up and forward were."""
    up, left = _snap_to_axis(zero.up()[0]), zero.left()[0]
    if facing is not None and float(facing @ up) < 0.5:
        left = torch.linalg.cross(up, facing)
    return _body_frame(_snap_to_axis(left), up)


def _first_frame_rotation(first: RigPoses, up: Tensor) -> Float[Tensor, "3 3"]:
    """Return the rotation of a clip's first frame to face +Z; its up axis is the world's."""
    return _body_frame(first.left()[0], up)


def _body_frame(left: Tensor, up: Tensor) -> Float[Tensor, "3 3"]:
    left = torch.nn.functional.normalize(left - up * (left @ up), dim=0)
    return torch.stack([left, up, torch.linalg.cross(left, up)])


def _snap_to_axis(direction: Tensor) -> Tensor:
    axis = nearest_axis_name(direction)
    return direction if axis == "unknown" else axis_vector(axis)


def _bone_direction(poses: RigPoses, name: str, front: Tensor) -> Float[Tensor, "3"]:
    bone = poses.bone(name)
    return torch.zeros(3, dtype=torch.float64) if bone is None else unit_vectors(front @ bone[0])


def _lay_out_tpose(
    base: RigPoses, front: Tensor, stands: bool, *, pitch: float | None, twists: dict[str, float]
) -> Float[Tensor, "joints 4"]:
    """Return the world rotation of each canonical joint's rig joint once the base pose is laid out as a T-pose."""
    turns: list[Tensor] = []
    for index, name in enumerate(CANONICAL.names):
        part = name.removeprefix("left").removeprefix("right")
        above = turns[CANONICAL.parents[index]] if index else front
        if part in ("Foot", "Toes"):
            turns.append(front if stands else _lay_out_foot(base, name, above, pitch))
            continue
        bone, aim = _bone_direction(base, name, above), _canonical_direction(index)
        apart = float(torch.arccos((bone @ aim).clamp(-1, 1)))
        aligned = part in _LIMBS or (part != "Hand" and apart > _TRUNK_TOLERANCE)
        if aligned and aim.norm() > 0 and bone.norm() > 0 and base.has(name):
            above = align_bone(bone, aim) @ above
        if name in twists:
            above = rotations.rotation_vector_to_matrix(aim * twists[name]) @ above
        turns.append(above)
    still = [rotations.from_matrix(turn) for turn in turns]
    joints = [
        base.orientations[0, joint] if joint is not None else still[0].new_tensor([0, 0, 0, 1])
        for joint in base.joint_of
    ]
    return torch.stack([rotations.multiply(turn, own) for turn, own in zip(still, joints, strict=True)])


def _lay_out_foot(base: RigPoses, name: str, above: Tensor, pitch: float | None) -> Tensor:
    """Lay a foot flat on the floor, or toes level, where the base pose is not a standing one."""
    bone, toes = base.bone(name), name.endswith("Toes")
    if toes and bone is None:
        bone = base.bone(name.replace("Toes", "Foot"))
    if bone is None:
        return above
    slope = 0.0 if toes else _canonical_foot_pitch() if pitch is None else pitch
    aim = torch.tensor([0.0, -math.sin(slope), math.cos(slope)], dtype=torch.float64)
    return align_bone(unit_vectors(above @ bone[0]), aim) @ above


def _canonical_direction(index: int) -> Float[Tensor, "3"]:
    """Return the direction of the bone that begins at a canonical joint; zero for hips and for the ends of limbs."""
    name = CANONICAL.names[index]
    if name == "hips" or not CANONICAL.children(index):
        return torch.zeros(3, dtype=torch.float64)
    return unit_vectors(CANONICAL.offsets[CANONICAL.children(index)[0]])


def _canonical_foot_pitch() -> float:
    _, y, z = CANONICAL.offsets[TOE_JOINTS[0]].tolist()
    return math.atan2(-y, z)


def _estimate_foot_pitch(clip: RigPoses | None, upright: Tensor | None) -> float | None:
    """Estimate the pitch of the foot's bone below level while the foot is flat, radians, from how much lower than the
    ankle the toe gets over the clip; None where the clip does not show it."""
    if clip is None or not clip.has("leftToes", "rightToes", "leftFoot", "rightFoot") or len(clip.positions) < 10:
        return None
    up = axis_vector("y") if upright is None else rotations.rotate(rotations.inverse(upright), axis_vector("y"))
    found = []
    for side in ("left", "right"):
        ankle, toes = clip.place(side + "Foot"), clip.place(side + "Toes")
        drop = float((ankle @ up).quantile(0.05) - (toes @ up).quantile(0.05))
        length = float((toes - ankle).norm(dim=-1).mean())
        if length < TOE_REST_HEIGHT / 2:
            return None
        found.append(math.asin(max(-1.0, min(1.0, drop / length))))
    slope = sum(found) / 2
    return slope if 0 < slope < math.radians(70) else None


def _untwist_tpose(base: RigPoses, front: Tensor, clip: RigPoses, upright: Tensor | None) -> Float[Tensor, "joints 4"]:
    """Return the T-pose of a rig whose zero pose is none: bones determine all but the twist of joints about them.

    Over a clip the trunk's joints are hardly twisted, knees bend backward and elbows forward: what contradicts that is
    corrected, from the hips outward.
    """
    pitch, twists = _estimate_foot_pitch(clip, upright), {}
    for name in (
        "spine",
        "chest",
        "neck",
        "head",
        *(side + part for side in ("left", "right") for part in ("Shoulder", "UpperArm", "UpperLeg")),
    ):
        quats = _lay_out_tpose(base, front, stands=False, pitch=pitch, twists=twists)
        if clip.has(name):
            hinged = name.endswith(("Arm", "Leg"))
            angle = _hinge_error(clip, name, quats, upright) if hinged else None
            angle = _mean_twist(clip, name, quats, upright) if angle is None else angle
            if abs(angle) > _MIN_TWIST:
                twists[name] = _QUARTER_TURN * round(angle / _QUARTER_TURN)
    return _lay_out_tpose(base, front, stands=False, pitch=pitch, twists=twists)


def _mean_twist(clip: RigPoses, name: str, quats: Tensor, upright: Tensor | None) -> float:
    """Return the rotation about a joint's bone, radians, that removes its mean twist against the joint above."""
    index = CANONICAL.index(name)
    above = CANONICAL.parents[index]
    while above > 0 and clip.joint_of[above] is None:
        above = CANONICAL.parents[above]
    turns = _canonical_rotations(clip, CANONICAL.names[above], quats, upright)
    local = rotations.multiply(rotations.inverse(turns), _canonical_rotations(clip, name, quats, upright))
    bone = _canonical_direction(index)
    bone = axis_vector("y") if bone.norm() == 0 else bone
    twist = 2 * torch.atan2(local[:, :3] @ bone, local[:, 3])
    return float(torch.atan2(torch.sin(twist).mean(), torch.cos(twist).mean()))


def _hinge_error(clip: RigPoses, name: str, quats: Tensor, upright: Tensor | None) -> float | None:
    """Return the rotation about an upper limb's bone, radians, by which the joint below bends as people's do; None if
    it hardly bends."""
    below = name.replace("Upper", "Lower")
    left = 1.0 if name.startswith("left") else -1.0
    wanted = axis_vector("x") if name.endswith("Leg") else -left * axis_vector("y")
    upper, lower = (_canonical_rotations(clip, joint, quats, upright) for joint in (name, below))
    bend = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(upper), lower)).mean(0)
    bone = _canonical_direction(CANONICAL.index(name))
    bend = bend - bone * (bend @ bone)
    if float(bend.norm()) < _MIN_HINGE_BEND:
        return None
    return float(torch.atan2(torch.linalg.cross(bend, wanted) @ bone, bend @ wanted))


def _canonical_rotations(clip: RigPoses, name: str, quats: Tensor, upright: Tensor | None) -> Float[Tensor, "poses 4"]:
    """Return the world rotations of a canonical joint over a clip."""
    index, frames = CANONICAL.index(name), len(clip.orientations)
    joint = clip.joint_of[index]
    assert joint is not None
    turns = rotations.multiply(clip.orientations[:, joint], rotations.inverse(quats[index]).expand(frames, 4))
    return turns if upright is None else rotations.multiply(upright.expand(frames, 4), turns)


def _local_rotations(base: RigPoses) -> Float[Tensor, "rigged 4"]:
    """Return the local rotations of the base pose."""
    parents, turns = base.skeleton.parents, base.orientations[0]
    return torch.stack(
        [
            turns[j] if p < 0 else rotations.multiply(rotations.inverse(turns[p]), turns[j])
            for j, p in enumerate(parents)
        ]
    )


def align_bone(start: Float[Tensor, "3"], stop: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return the shortest rotation between unit vectors; of about opposite ones, the half turn about +Z if it is one.

    Unlike `rotations.between_vectors`, it keeps the other axes of rigs whose bones all lie along one local axis: a
    thigh that points up is rotated down sideways, not through a somersault, and its knee still bends backward.
    """
    axis, cosine = torch.linalg.cross(start, stop), start @ stop
    if cosine < 0 and axis.norm() < 0.1:
        across = axis_vector("z") if float(start[2].abs()) < 0.7 else axis_vector("y")
        half = torch.nn.functional.normalize(across - start * (across @ start), dim=0)
        over = rotations.rotation_vector_to_matrix(half * math.pi)
        return align_bone(over @ start, stop) @ over
    sine = axis.norm().clamp_min(1e-12)
    return rotations.rotation_vector_to_matrix(axis / sine * torch.atan2(sine, cosine))
