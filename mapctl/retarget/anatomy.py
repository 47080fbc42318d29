"""Joint frames, up axis and sides of a body from its anatomy: where its joints are over a clip, and how they bend.

Each joint's frame follows from two directions whose canonical counterparts are known: the bone, and a second one across
it (hip line, shoulder line, hinge axis of a knee or elbow). Both are averaged over the clip in the joint's own frame,
so the result does not depend on how a file orients its joint axes, nor on what its pose with all rotations zero is.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.retarget.rig_poses import RigPoses, unit_vectors
from mapctl.skeleton import CANONICAL

CONTRADICTION = math.radians(75)
"""Angle between two readings of a joint from which one of them is wrong. Rigs orient joints in quarter turns; hinge
axes of real rigs are up to 53 degrees off their T-pose's (MakeHuman's knees, MocapNET's elbows)."""
CORE = ("hips", "chest", *(side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg")))
"""Joints that positions and knees determine beyond doubt: a T-pose that contradicts one of them is none."""
_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
# Knees of people who stand are up to 7 degrees past straight, which shows no hinge axis.
_MIN_BEND = 0.15  # mean sine of the angle at a knee or elbow from which its hinge axis is known
_HEAD_UP = 0.5  # least mean cosine between the chest's up axis and a head's End Site that is the top of the head
_HINGE_SHARE = 0.7  # of all bending that is about the hinge axis, from which there is one
_STRAIGHT_POWER = 20  # legs count by this power of their extension: 0.67 at 98 %, 0.12 at 90 %, 0.01 at 80 %
_SPINE_WEIGHT = 0.05  # of the bone above the hips against legs
_ROUNDING = math.radians(15)  # between an axis and a direction that it is taken for, in all of CORE
_PITCH_WEIGHT = 0.02  # of the canonical foot's pitch against the share of frames in which a foot stands
_MAX_PITCH = math.radians(70)  # of the bone of a flat foot: an End Site may be straight under the ankle
_REST_WEIGHT = 1.25  # of a standing rest pose against an upright trunk; hanging arms weigh half as much as the trunk
_Y_UP_WEIGHT = 0.25  # of what most files have
_STANDING = 0.8  # cosine between the thighs and the body's down in a pose that stands
_NO_LINE = 1e-3  # metres between two joints below which they are one
_X, _Y, _Z = torch.eye(3, dtype=torch.float64)
SIGNS = (("left", 1.0), ("right", -1.0))
"""Signs of x on each side of the body."""

Vectors = Float[Tensor, "poses 3"]


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Joint frames of a clip's body as positions and bends determine them."""

    frames: Mapping[str, Float[Tensor, "3 3"]]
    """World rotation of the rig's joint in the canonical T-pose (Y up, facing +Z), by canonical joint."""
    certain: Mapping[str, Float[Tensor, "3 3"]]
    """Those of the joints that rigid offsets and bends determine within CONTRADICTION, the hips by the spine."""
    in_quarter_turns: bool
    """Whether joint axes are along the canonical ones, so that frames are exact but for the feet's pitch."""

    def find_contradictions(self, tpose: Float[Tensor, "joints 4"]) -> dict[str, float]:
        """Return the joints whose world rotation (xyzw) in a T-pose is off by more than CONTRADICTION, each with the
        angle in radians."""
        quats = {name: tpose[CANONICAL.index(name)] for name in self.certain}
        angles = {name: _angle_between(self.certain[name], rotations.to_matrix(quat)) for name, quat in quats.items()}
        return {name: angle for name, angle in angles.items() if angle > CONTRADICTION}

    def correct(self, tpose: Float[Tensor, "joints 4"], names: Collection[str]) -> Float[Tensor, "joints 4"]:
        """Return a T-pose with these joints as the clip shows them, and the arms that they are of from the upper arm
        on, whose rolls belong together."""
        fixed = tpose.clone()
        arms = [name.removesuffix(_ARM[1]) + part for name in names if name.endswith(_ARM[1]) for part in _ARM[2:]]
        for name in {*names, *arms} & self.frames.keys():
            fixed[CANONICAL.index(name)] = rotations.from_matrix(self.frames[name])
        return fixed


@dataclass
class _Builder:
    """Frames found so far, and the rotations that they give the canonical joints over the clip."""

    clip: RigPoses
    turns: Float[Tensor, "poses rigged 3 3"]
    in_quarter_turns: bool = False
    """Whether joint axes lie along the canonical ones, so that directions are rounded to them."""
    frames: dict[str, Tensor] = field(default_factory=dict)
    measured: dict[str, Tensor] = field(default_factory=dict)
    """The same frames before they are rounded."""

    def average(self, name: str, vectors: Vectors) -> Float[Tensor, "3"]:
        """Average world vectors in the own frame of a canonical joint's rig joint."""
        return torch.einsum("tji,tj->ti", self.turns[:, self.clip.joint(name)], vectors).mean(0)

    def axis(self, name: str, axis: Tensor) -> Vectors:
        """Return where an axis of a canonical joint that has a frame points in the world, over the clip."""
        return self.turns[:, self.clip.joint(name)] @ (self.frames[name].T @ axis)

    def is_hinge(self, name: str, normals: Vectors) -> bool:
        """Return whether the limb bends far enough and about one axis of its upper joint; `normals` are those of its
        plane, of the length of the bend's sine."""
        bend = float(self.average(name, normals).norm())
        return bend > max(_MIN_BEND, _HINGE_SHARE * float(normals.norm(dim=-1).mean()))

    def orient(self, name: str, first: Vectors, aim: Tensor, second: Vectors, aim_second: Tensor) -> None:
        """Give a joint the frame in which the first direction is its canonical one, and the second as nearly so as
        that allows."""
        one, two = unit_vectors(self.average(name, first)), unit_vectors(self.average(name, second))
        target = orthonormal_frame(aim, aim_second)
        self.measured[name] = self.frames[name] = target @ orthonormal_frame(one, two).T
        if self.in_quarter_turns:
            one = _nearest_axis(one)
            self.frames[name] = target @ orthonormal_frame(one, _nearest_axis(two - one * (one @ two))).T

    def continue_frame(self, name: str, above: str) -> None:
        """Give the end of a limb the frame of the joint above where that is near enough, else the measured one: rigs
        built in quarter turns are straight with its rotation zero, while its mean is how the body holds it."""
        if self.in_quarter_turns and self.clip.has(above):
            near = _angle_between(self.measured[name], self.frames[above]) < CONTRADICTION
            self.frames[name] = self.frames[above] if near else self.measured[name]


def estimate_frames(
    clip: RigPoses, upright: Float[Tensor, "4"] | None, own: Float[Tensor, "rigged 4"] | None = None
) -> Anatomy:
    """Estimate the frames of all joints that the rig has; `upright` takes the file's world to one with Y up.

    Where the axes of all joints of CORE are near the canonical ones, the rig is built in quarter turns, and its joints
    are rounded to them. `own` is the rotation (xyzw) of each joint's own axes in the file against those of the poses.
    """
    axes = None if own is None else rotations.to_matrix(own)
    turns = rotations.to_matrix(clip.orientations)
    turns = turns if axes is None else turns @ axes
    found, certain = _orient_joints(_Builder(clip, turns), upright)
    if all(_is_near_quarter_turn(found.frames[name]) for name in CORE if clip.has(name)):
        found, _ = _orient_joints(_Builder(clip, turns, in_quarter_turns=True), upright)
    frames = found.frames
    if axes is not None:
        frames, certain = (
            {name: frame @ axes[clip.joint(name)].T for name, frame in some.items()} for some in (frames, certain)
        )
    return Anatomy(frames, certain, found.in_quarter_turns)


def _orient_joints(found: _Builder, upright: Tensor | None) -> tuple[_Builder, dict[str, Tensor]]:
    """Orient all joints; also return the frames of those that are certain."""
    clip, pitch = found.clip, _estimate_foot_pitch(found.clip, upright)
    # Files disagree by 33 degrees about where the spine is over the hips: enough to tell which pelvis is wrong.
    found.orient("hips", clip.side_line("UpperLeg"), _X, clip.position("spine") - clip.middle("UpperLeg"), _Y)
    certain = {"hips": found.frames["hips"]}
    known = [*_orient_trunk(found)]
    for side, sign in SIGNS:
        known += [*_orient_arm(found, side, sign), *_orient_leg(found, side, pitch)]
    return found, certain | {name: found.frames[name] for name in known}


def _orient_trunk(found: _Builder) -> Iterator[str]:
    clip = found.clip
    found.orient("hips", clip.side_line("UpperLeg"), _X, _pelvis_up(clip), _Y)
    top = "chest" if clip.has("chest") else "spine"
    if top == "chest":
        found.orient("chest", clip.side_line("Shoulder"), _X, _bone(clip, "chest", clip.up()), _Y)
        yield "chest"
    across = found.axis("hips", _X) + (found.axis("chest", _X) if top == "chest" else clip.side_line("Shoulder"))
    found.orient("spine", _bone(clip, "spine", clip.up()), _Y, across, _X)
    for name in ("neck", "head"):
        if clip.has(name):
            up, bone = found.axis(top, _Y), _bone(clip, name, found.axis(top, _Y))
            bone = bone if float((bone * up).sum(-1).mean()) > _HEAD_UP else up
            found.orient(name, bone, _Y, found.axis(top, _X), _X)
    if clip.has("head"):
        found.continue_frame("head", "neck")


def _orient_arm(found: _Builder, side: str, sign: float) -> Iterator[str]:
    """Orient the joints of an arm: bones lie along x, the elbow bends toward +z."""
    clip, above = found.clip, "chest" if found.clip.has("chest") else "spine"
    shoulder, upper, lower, hand = (side + part for part in _ARM)
    if clip.has(shoulder):
        found.orient(
            shoulder, _bone(clip, shoulder, sign * found.axis(above, _X)), sign * _X, found.axis(above, _Y), _Y
        )
        above = shoulder
        yield shoulder
    arm = _bone(clip, upper)
    forearm = _bone(clip, lower, arm)
    hinge = -sign * torch.linalg.cross(arm, forearm)
    bends = found.is_hinge(upper, hinge)
    # An arm that stays straight has no more twist against the body than the shortest arc from the T-pose gives it.
    arc = rotations.between_vectors(sign * found.axis(above, _X), arm)
    found.orient(upper, arm, sign * _X, hinge if bends else rotations.rotate(arc, found.axis(above, _Y)), _Y)
    found.orient(lower, forearm, sign * _X, hinge if bends else found.axis(upper, _Y), _Y)
    if clip.has(hand):
        found.orient(hand, _bone(clip, hand, forearm), sign * _X, found.axis(lower, _Y), _Y)
        found.continue_frame(hand, lower)
    if bends:
        yield upper


def _orient_leg(found: _Builder, side: str, pitch: float) -> Iterator[str]:
    """Orient the joints of a leg: bones lie along -y, the knee bends toward -z, the foot is as when it is flat."""
    clip = found.clip
    upper, lower, foot, toes = (side + part for part in ("UpperLeg", "LowerLeg", "Foot", "Toes"))
    thigh, shin = _bone(clip, upper), _bone(clip, lower)
    hinge = torch.linalg.cross(thigh, shin)
    bends = found.is_hinge(upper, hinge)
    hinge = hinge if bends else found.axis("hips", _X)
    found.orient(upper, thigh, -_Y, hinge, _X)
    found.orient(lower, shin, -_Y, hinge, _X)
    if bends:
        yield from (upper, lower)
    bone = clip.bone(foot)
    if bone is None:  # nothing but the shin shows where the foot points
        found.orient(foot, shin, -_Y, found.axis(lower, _X), _X)
    else:
        flat = torch.tensor([0.0, -math.sin(pitch), math.cos(pitch)], dtype=torch.float64)
        across = found.axis(lower, _X)
        found.orient(foot, bone, flat, across, _X)
        if found.in_quarter_turns and _angle_between(found.frames[foot], found.measured[foot]) > _ROUNDING:
            # The foot's axes are along its sole, not along its bone.
            bone = unit_vectors(bone)
            level = math.cos(pitch) * bone + math.sin(pitch) * torch.linalg.cross(bone, unit_vectors(across))
            found.orient(foot, level, _Z, across, _X)
    if clip.has(toes):
        found.orient(toes, found.axis(foot, _X), _X, found.axis(foot, _Y), _Y)


def _pelvis_up(clip: RigPoses) -> Vectors:
    """Return the pelvis's up direction, weighted: against the legs where both are stretched, else along the spine."""
    (left, first), (right, second) = (_leg_extension(clip, side) for side, _ in SIGNS)
    return _SPINE_WEIGHT * unit_vectors(clip.position("spine") - clip.middle("UpperLeg")) - first * second * (
        left + right
    )


def _leg_extension(clip: RigPoses, side: str) -> tuple[Vectors, Float[Tensor, "poses 1"]]:
    """Return the unit vector from hip to ankle, and how stretched the leg is: about 1 where it stands, 0 where not."""
    hip, knee, ankle = (clip.position(side + part) for part in ("UpperLeg", "LowerLeg", "Foot"))
    length = (knee - hip).norm(dim=-1) + (ankle - knee).norm(dim=-1)
    extension = (ankle - hip).norm(dim=-1) / length.clamp_min(1e-9)
    return unit_vectors(ankle - hip), (extension**_STRAIGHT_POWER)[:, None]


def _estimate_foot_pitch(clip: RigPoses, upright: Tensor | None) -> float:
    """Estimate how far the bones of the feet point below level while they are flat, radians: the mean over frames,
    weighted by how stretched the leg and how low the ankle is; the canonical feet's where no frame counts."""
    _, y, z = unit_vectors(CANONICAL.offsets[CANONICAL.index("leftToes")]).tolist()
    up = _Y if upright is None else rotations.rotate(rotations.inverse(upright), _Y)
    total, weights = math.atan2(-y, z) * _PITCH_WEIGHT, _PITCH_WEIGHT
    for side, _ in SIGNS:
        bone = clip.bone(side + "Foot")
        if bone is None:
            continue
        ankle = clip.position(side + "Foot") @ up
        over = (ankle - ankle.quantile(0.1)).clamp_min(0) / (0.1 * float(bone.norm(dim=-1).mean()) + 1e-9)
        weight = torch.exp(-over) * _leg_extension(clip, side)[1][:, 0]
        pitch = torch.asin((unit_vectors(bone) @ -up).clamp(-1, 1))
        total, weights = total + float((weight * pitch).mean()), weights + float(weight.mean())
    return min(max(total / weights, 0.0), _MAX_PITCH)


def _bone(clip: RigPoses, name: str, otherwise: Vectors | None = None) -> Vectors:
    """Return the direction of a joint's bone, or the other one where it has none of some length."""
    bone = clip.bone(name)
    if otherwise is not None and (bone is None or float(bone.norm(dim=-1).mean()) < _NO_LINE):
        return otherwise
    assert bone is not None
    return unit_vectors(bone)


def _is_near_quarter_turn(frame: Tensor) -> bool:
    rounded = torch.stack([_nearest_axis(axis) for axis in frame])
    return _angle_between(frame, rounded) < _ROUNDING


def _angle_between(first: Tensor, second: Tensor) -> float:
    """Return the angle of the rotation between two frames, radians."""
    return float(torch.arccos(((torch.trace(first.T @ second) - 1) / 2).clamp(-1, 1)))


def _nearest_axis(direction: Tensor) -> Float[Tensor, "3"]:
    """Return the axis, with its sign, that a direction is nearest to."""
    largest = int(direction.abs().argmax())
    return torch.eye(3, dtype=direction.dtype)[largest] * direction[largest].sign()


def orthonormal_frame(first: Tensor, second: Tensor) -> Float[Tensor, "3 3"]:
    """Return the right-handed frame whose first column is along `first` and whose second is nearest to `second`."""
    first = unit_vectors(first)
    second = unit_vectors(second - first * (first @ second))
    if float(second.norm()) < 0.5:  # parallel: any direction across is as good
        across = torch.eye(3, dtype=first.dtype)[int(first.abs().argmin())]
        second = unit_vectors(across - first * (first @ across))
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=1)


def find_up_axis(clip: RigPoses, rest_up: Tensor | None) -> str:
    """Find the axis of the file's world that is up, one of `x y z -x -y -z`; Y where no other is plainly better.

    The trunk stands along it and arms hang against it, a standing rest pose (`rest_up`) has it, and the body's lowest
    point stays at 0 along it. A crawl's trunk lies along another axis in all of its frames; its arms, its rest pose and
    the floor outvote that.
    """
    positions = clip.positions[:, [joint for joint in clip.joint_of if joint is not None]]
    arms = unit_vectors(clip.middle("LowerArm") - clip.middle("UpperArm"))
    height = 2 * float((clip.middle("UpperArm") - clip.middle("UpperLeg")).norm(dim=-1).mean()) + 1e-9
    upright = (clip.up() - 0.5 * arms).mean(0) + (0.0 if rest_up is None else _REST_WEIGHT * rest_up)

    def score(axis: str) -> float:
        index, sign = "xyz".index(axis[-1]), -1.0 if axis.startswith("-") else 1.0
        floor = float((sign * positions[..., index]).amin(dim=1).square().mean().sqrt()) / height
        return sign * float(upright[index]) - min(floor, 1.0) + (_Y_UP_WEIGHT if axis == "y" else 0.0)

    return max(("y", "z", "x", "-y", "-z", "-x"), key=score)


def measure_front(poses: RigPoses) -> Float[Tensor, " poses"]:
    """Measure whether what is named left is on the left, by pose: positive where toes point to the body's front and
    knees bend away from it, about -1 where sides are exchanged, near 0 where a pose shows neither."""
    left, up = poses.left(), poses.up()
    front, votes = torch.linalg.cross(left, up), torch.zeros_like(left[:, 0])
    for side, _ in SIGNS:
        thigh, shin = _bone(poses, side + "UpperLeg"), _bone(poses, side + "LowerLeg")
        votes = votes + (torch.linalg.cross(thigh, shin) * left).sum(-1)
        bone = poses.bone(side + "Foot")
        if bone is not None:  # a foot that goes on along the shin shows no front
            toes = unit_vectors(bone)
            toes = toes - shin * (toes * shin).sum(-1, keepdim=True)
            votes = votes + (toes * front).sum(-1)
    return votes / 2


def are_sides_swapped(zero: RigPoses, clip: RigPoses | None) -> bool:
    """Return whether the joints named left are on the right: by the clip where it shows the body's front, else by the
    pose with all rotations zero where that has legs below the trunk."""
    thighs = unit_vectors(_bone(zero, "leftUpperLeg") + _bone(zero, "rightUpperLeg"))
    stands = float((thighs * zero.up()).sum()) < -_STANDING
    shown = [float(measure_front(poses).mean()) for poses in (clip, zero if stands else None) if poses is not None]
    sure = [vote for vote in shown if abs(vote) > MIN_FRONT]
    return bool(sure) and sure[0] < 0


MIN_FRONT = 0.3
"""Least mean of `measure_front` from which it counts."""
