"""The T-pose of any rig, from the readings that its file and its table offer, and the performer's bones in it.

A table, a standing pose with all rotations zero and a first frame that is a T-pose are readings; each is held against
how the body of a clip is built and bends (`anatomy`), and the first that fits is taken. Where none does, or there is
none, anatomy is the T-pose. A standing pose is rotated upright and to face +Z; then each limb is laid along its
canonical direction by the shortest arc: each joint of a T-pose from its own orientation, those of an A-pose with the
limb above. Feet keep their orientation; hands go with the arm.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.retarget.anatomy import (
    CORE,
    SIGNS,
    JointOf,
    RigPoses,
    estimate_frames,
    find_up_axis,
    next_joint,
    orthonormal_frame,
    unit_vectors,
)
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, Skeleton

_LIMBS = ("UpperArm", "LowerArm", "UpperLeg", "LowerLeg")
_SNAP = math.radians(20)  # a rest pose whose up or facing is this near an axis has it along that axis
_TRUNK_TOLERANCE = math.radians(40)  # trunk and shoulders keep their own shape up to here
# Of arms below level: a T-pose up to the first, an A-pose up to the second.
_LEVEL, _HANGING = math.radians(25), math.radians(100)
_LEG_TOLERANCE = math.radians(35)  # between the legs of a standing rest pose and the vertical
_EXACT_TPOSE_ANGLE = math.radians(15)  # of arms and legs in a frame that is a T-pose on purpose
UNROTATED = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
_END_SITES = ("Toes", "Hand", "head")  # joints whose position an End Site of the joint above may give


@dataclass(frozen=True, eq=False)
class TPose:
    """The pose of the rig that corresponds to the canonical skeleton's rest pose."""

    tpose_quat_xyzw: Float[Tensor, "joints 4"]
    """B: world rotation (xyzw) of each canonical joint's rig joint in the T-pose, in a world with Y up."""
    idle_quat_xyzw: Float[Tensor, "rigged 4"]
    """Local rotations in the T-pose of joints that are no canonical one; those of others do not count."""
    upright_quat_xyzw: Float[Tensor, "4"] | None
    """U: rotation from the file's world to one with Y up, xyzw; None where Y is up already."""
    up: str
    """Axis of the file's world that points up."""
    facing: str
    """Axis of the file that the pose with all rotations zero faces; `unknown` where it is along none."""
    rest: str
    """Kind of the pose with all rotations zero: T, A or neither."""
    tpose_from: str
    """Where the T-pose was found: table, rest pose, frame 0, or motion."""
    tpose_doubt: str = ""
    """Why the T-pose may be wrong, a sentence without a full stop; empty where it agrees with the clip."""


def find_tpose(
    zero: RigPoses,
    clip: RigPoses | None,
    *,
    rig: Rig,
    stated: bool,
    up: str | None = None,
    own: Float[Tensor, "rigged 4"] | None = None,
) -> TPose:
    """Find the T-pose of a rig. What a user `stated` about it is taken as it is; what a preset has is evidence.

    `up` is the up axis that the file declares; one that the rig sets wins. `own` is the rotation (xyzw) of each joint's
    axes in the file against those of the poses.
    """
    upward, left = _snap_to_axis(zero.up()[0]), zero.left()[0]
    facing = None if rig.facing == "auto" else axis_vector(rig.facing)
    if facing is not None and float(facing @ upward) < 0.5:
        left = torch.linalg.cross(upward, facing)
    front = _body_frame(_snap_to_axis(left), upward)  # from the zero pose to upright, facing +Z
    rest = classify_reference_pose(zero, front)
    if rig.up != "auto":
        up = rig.up
    elif not up and clip is not None:
        up = find_up_axis(clip, None if rest == "neither" else zero.up()[0])
    elif not up:
        up = "z" if nearest_axis_name(zero.up()[0]) == "z" else "y"
    upright = upright_rotation(up)
    names, still = zero.skeleton.names, (0.0, 0.0, 0.0, 1.0)
    resting = torch.stack([torch.tensor(rig.idle.get(name, still), dtype=torch.float64) for name in names])
    faces = "unknown" if rest == "neither" else nearest_axis_name(front[2])

    def choose(quats: Tensor, idle: Tensor, source: str, doubt: str = "") -> TPose:
        return TPose(quats, idle, upright, up, faces, rest, source, doubt)

    # Readings: rotations of canonical joints, idle rotations of the rig's, and where they come from.
    readings: list[tuple[Tensor, Tensor, str]] = []
    laid_out = _lay_out_tpose(zero, front) if rest != "neither" or rig.rest == "straighten" else None
    # A preset's table is of files as its program writes them; one whose rest pose is another has other joint frames.
    has_table = rig.rest == "tpose" or (rig.rest == "auto" and bool(rig.tpose))
    if has_table and (stated or rest == "neither" or is_canonical_tpose(zero)):
        # Joints that the table leaves out are as in the rest pose, or unrotated where that is to be the T-pose or none.
        known = None if rig.rest == "tpose" else laid_out
        quats = UNROTATED.repeat(CANONICAL.num_joints, 1) if known is None else known.clone()
        for name, axes in rig.tpose.items():
            quats[CANONICAL.index(name)] = rotations.from_matrix(frame_from_axes(axes))
        readings.append((quats, resting, "table"))
    if laid_out is not None:
        readings.append((laid_out, resting, "rest pose"))
    if clip is None:
        return choose(*(*readings, (_lay_out_tpose(zero, front), resting, "rest pose"))[0])
    if rig.rest in ("auto", "frame0"):
        first = replace(clip, positions=clip.positions[:1], orientations=clip.orientations[:1])
        turned = _body_frame(first.left()[0], axis_vector(up))
        if rig.rest == "frame0" or _is_exact_tpose(first, turned):
            readings.append((_lay_out_tpose(first, turned), _mean_locals(first), "frame 0"))
    anatomy, refused = estimate_frames(clip, upright, own), ""
    for quats, idle, found in readings:
        contradicted, doubt = anatomy.find_contradictions(quats), ""
        if contradicted:
            listed, more = ", ".join([*contradicted][:3]), len(contradicted) - 3
            listed += f" and {more} more" if more > 0 else ""
            are = f"{'is' if len(contradicted) == 1 else 'are'} {math.degrees(max(contradicted.values())):.0f} degrees"
            doubt = f"{listed} {are} off in the {found} by how the body moves"
        if stated and (rig.tpose or rig.rest != "auto"):
            return choose(quats, idle, found, doubt)
        if not contradicted.keys() & CORE:
            doubt = doubt and f"{doubt}, which is followed for the arm"
            return choose(anatomy.correct(quats, contradicted), idle, found, doubt)
        refused = refused or doubt
    frames = anatomy.correct(torch.zeros(CANONICAL.num_joints, 4, dtype=torch.float64), CANONICAL.names)
    doubt = refused and f"{refused}, which is followed"
    if not anatomy.certain.keys() >= {"leftUpperLeg", "rightUpperLeg"}:
        doubt = "no pose of the file is a T- or A-pose and knees hardly bend: how limbs are twisted is a guess"
    elif not anatomy.in_quarter_turns:
        doubt = doubt or "no pose of the file is a T- or A-pose: joint frames are estimated by how the body moves"
    return choose(frames, _mean_locals(clip), "motion", doubt)


def frame_from_axes(axes: Mapping[str, list[float]]) -> Float[Tensor, "3 3"]:
    """Return the rotation whose first two columns point along the axes x and (as nearly as they are square) y."""
    return orthonormal_frame(*(torch.tensor(axes[name], dtype=torch.float64) for name in "xy"))


def is_canonical_tpose(zero: RigPoses) -> bool:
    """Return whether the pose with all rotations zero is a T-pose with Y up that faces +Z."""
    return classify_reference_pose(zero, torch.eye(3, dtype=torch.float64)) == "T"


def classify_reference_pose(poses: RigPoses, front: Float[Tensor, "3 3"]) -> str:
    """Classify the first pose as a T-pose, an A-pose (arms anywhere between level and hanging), or neither.

    `front` rotates it to be upright and face +Z.
    """
    limbs = [(side + half, sign) for side, sign in SIGNS for half in ("Upper", "Lower")]
    arms = [(_bone_direction(poses, limb + "Arm", front), sign) for limb, sign in limbs]
    legs = [_bone_direction(poses, limb + "Leg", front) for limb, _ in limbs]
    if any(float(-leg[1]) < math.cos(_LEG_TOLERANCE) for leg in legs):
        return "neither"
    arms = [(arm, sign) for arm, sign in arms if float(arm.norm()) > 0]
    lowered = [math.atan2(-float(arm[1]), max(sign * float(arm[0]), -0.2)) for arm, sign in arms]
    if any(abs(float(arm[2])) > 0.6 for arm, _ in arms) or not all(-_LEVEL < low < _HANGING for low in lowered):
        return "neither"
    return "T" if max(lowered) < _LEVEL else "A"


def upright_rotation(up: str) -> Float[Tensor, "4"] | None:
    """Return the rotation from a world with this up axis to one with Y up; None where it is Y already."""
    return None if up == "y" else rotations.between_vectors(axis_vector(up), axis_vector("y"))


def _is_exact_tpose(poses: RigPoses, front: Float[Tensor, "3 3"]) -> bool:
    """Return whether the first pose is a T-pose that captures begin with: all straight, arms level, legs vertical."""
    limbs = [
        (side + half + part, aim)
        for side, sign in SIGNS
        for part, aim in (("Arm", axis_vector("x") * sign), ("Leg", -axis_vector("y")))
        for half in ("Upper", "Lower")
    ]
    bones = [(_bone_direction(poses, name, front), aim) for name, aim in limbs]
    return all(float(bone @ aim) >= math.cos(_EXACT_TPOSE_ANGLE) for bone, aim in bones)


def axis_vector(axis: str) -> Float[Tensor, "3"]:
    """Return the vector of an axis by name, as `-z`."""
    return torch.eye(3, dtype=torch.float64)["xyz".index(axis[-1])] * (-1 if axis.startswith("-") else 1)


def nearest_axis_name(direction: Float[Tensor, "3"]) -> str:
    """Return the axis that a unit vector points along; `unknown` if it is none."""
    largest = int(direction.abs().argmax())
    if float(direction[largest].abs()) < math.cos(_SNAP):
        return "unknown"
    return ("-" if float(direction[largest]) < 0 else "") + "xyz"[largest]


def _body_frame(left: Tensor, up: Tensor) -> Float[Tensor, "3 3"]:
    left = unit_vectors(left - up * (left @ up))
    return torch.stack([left, up, torch.linalg.cross(left, up)])


def _snap_to_axis(direction: Tensor) -> Tensor:
    axis = nearest_axis_name(direction)
    return direction if axis == "unknown" else axis_vector(axis)


def _bone_direction(poses: RigPoses, name: str, front: Tensor) -> Float[Tensor, "3"]:
    bone = poses.bone(name)
    return torch.zeros(3, dtype=torch.float64) if bone is None else unit_vectors(front @ bone[0])


def _lay_out_tpose(base: RigPoses, front: Tensor) -> Float[Tensor, "joints 4"]:
    """Return the world rotation of each canonical joint's rig joint once a standing pose is laid out as a T-pose."""
    turns: list[Tensor] = []
    is_t = classify_reference_pose(base, front) == "T"
    for index, name in enumerate(CANONICAL.names):
        part = name.removeprefix("left").removeprefix("right")
        if index == 0 or part in ("Foot", "Toes") or (is_t and part != "Hand"):
            turn = front
        else:
            turn = turns[CANONICAL.parents[index]]
        following, bone = next_joint(name), _bone_direction(base, name, turn)
        aim = unit_vectors(CANONICAL.offsets[CANONICAL.index(following)]) if following else torch.zeros_like(bone)
        apart = float(torch.arccos((bone @ aim).clamp(-1, 1)))
        aligned = part in _LIMBS or (part not in ("Hand", "Foot", "Toes") and apart > _TRUNK_TOLERANCE)
        if aligned and aim.norm() > 0 and bone.norm() > 0 and base.has(name):
            turn = rotations.to_matrix(rotations.between_vectors(bone, aim)) @ turn
        turns.append(turn)
    joints = [UNROTATED if joint is None else base.orientations[0, joint] for joint in base.joint_of]
    still = (rotations.from_matrix(turn) for turn in turns)
    return torch.stack([rotations.multiply(turn, own) for turn, own in zip(still, joints, strict=True)])


def _mean_locals(clip: RigPoses) -> Float[Tensor, "rigged 4"]:
    """Return the mean local rotations of a clip, which joints between canonical ones have in its body's T-pose."""
    return rotations.average(kinematics.local_from_world(clip.skeleton.parents, clip.orientations))


def rest_rotations(skeleton: Skeleton, joint_of: JointOf, tpose: TPose) -> Float[Tensor, "rigged 4"]:
    """Return the world rotations (xyzw) of a rig's joints in the T-pose, with Y up; joints that are no canonical one
    rest in their parents."""
    canonical = {joint: tpose.tpose_quat_xyzw[c] for c, joint in enumerate(joint_of) if joint is not None}
    root = UNROTATED if tpose.upright_quat_xyzw is None else tpose.upright_quat_xyzw
    found: list[Tensor] = []
    for joint, parent in enumerate(skeleton.parents):
        above = found[parent] if parent >= 0 else root
        found.append(canonical.get(joint, rotations.multiply(above, tpose.idle_quat_xyzw[joint])))
    return torch.stack(found)


def measure_bones(skeleton: Skeleton, joint_of: JointOf, tpose: TPose) -> Skeleton:
    """Measure a rig's bones on the canonical skeleton, metres.

    A joint that the rig lacks is put where the End Site of the joint above is, between its neighbours, or, at the end
    of a limb, as far on as the canonical one in scale.
    """
    turn, joint_positions = rest_rotations(skeleton, joint_of, tpose), [torch.zeros(3, dtype=torch.float64)]
    for joint, parent in enumerate(skeleton.parents[1:], start=1):
        joint_positions.append(joint_positions[parent] + rotations.rotate(turn[parent], skeleton.offsets[joint]))
    ends = {}
    for name, site in skeleton.end_offsets.items():
        joint = skeleton.index(name)
        ends[joint] = rotations.rotate(turn[joint], torch.tensor(site, dtype=torch.float64))
    known = {c: joint_positions[joint] for c, joint in enumerate(joint_of) if joint is not None}
    spots: list[Tensor] = []
    for c in range(CANONICAL.num_joints):
        spots.append(known[c] if c in known else _estimate_position(c, joint_of, spots, known, ends))
    positions = torch.stack(spots)
    offsets = torch.cat(
        [torch.zeros(1, 3, dtype=torch.float64), positions[1:] - positions[list(CANONICAL.parents[1:])]]
    )
    tips = {}
    for c, joint in enumerate(joint_of):
        if joint in ends and not CANONICAL.children(c):
            x, y, z = ends[joint].tolist()
            tips[CANONICAL.names[c]] = (x, y, z)
    return Skeleton(CANONICAL.names, CANONICAL.parents, offsets, tips)


def _estimate_position(
    c: int, joint_of: JointOf, spots: list[Tensor], known: Mapping[int, Tensor], ends: Mapping[int, Tensor]
) -> Float[Tensor, "3"]:
    """Estimate the position of a joint that the rig lacks, metres."""
    name, parent = CANONICAL.names[c], CANONICAL.parents[c]
    above, own = joint_of[parent], float(CANONICAL.offsets[c].norm())
    if name.endswith(_END_SITES) and above is not None and above in ends:
        return spots[parent] + ends[above]
    length, following = own, next_joint(name)
    while following is not None:
        length += float(CANONICAL.offsets[CANONICAL.index(following)].norm())
        if CANONICAL.index(following) in known:
            return spots[parent] + (known[CANONICAL.index(following)] - spots[parent]) * (own / length)
        following = next_joint(following)
    # The performer's size against the canonical skeleton, from the reach of the joints so far.
    reach = sum(float((spot - spots[CANONICAL.parents[k]]).norm()) for k, spot in enumerate(spots) if k)
    usual = float(CANONICAL.offsets[1 : len(spots)].norm(dim=-1).sum())
    return spots[parent] + CANONICAL.offsets[c] * (reach / usual if reach > 0 and usual > 0 else 1.0)
