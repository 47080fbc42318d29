"""Joint frames, up axis and sides of a body from its anatomy: where its joints are over a clip, and how they bend.

Each joint's frame follows from two directions whose canonical counterparts are known: the bone, and a second one across
it (hip line, shoulder line, hinge axis of a knee or elbow). Both are averaged over the clip in the joint's own frame,
so the result does not depend on how a file orients its joint axes, nor on what its pose with all rotations zero is.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

SAMPLES = 200
"""Number of frames of a clip that are looked at, spread over it."""
_POINTS_APART = 1e-3  # metres between two joints below which they are one

JointOf = Sequence[int | None]
"""For each canonical joint the rig's joint, or None."""


@dataclass(frozen=True, eq=False)
class RigPoses:
    """Poses of one rig in its file's world: frames of a clip, or the single pose with all rotations zero."""

    positions: Float[Tensor, "poses joints 3"]
    """World positions, metres."""
    orientations: Float[Tensor, "poses joints 4"]
    """World rotations (xyzw)."""
    skeleton: Skeleton
    joint_of: tuple[int | None, ...]
    """Index of the rig's joint for each canonical joint, or None."""

    @staticmethod
    def zero(skeleton: Skeleton, joint_of: JointOf = range(CANONICAL.num_joints)) -> "RigPoses":
        """Return the pose with all rotations zero; of canonical joints where none are named."""
        rest = Motion.at_rest(skeleton)
        return RigPoses(rest.joint_positions(), rest.joint_rotations(), skeleton, tuple(joint_of))

    @staticmethod
    def of(motion: Motion, joint_of: JointOf) -> "RigPoses":
        """Sample up to SAMPLES frames of a clip, the first among them."""
        picked = torch.linspace(0, motion.num_frames - 1, min(SAMPLES, motion.num_frames)).round().long()
        return RigPoses(
            motion.joint_positions()[picked], motion.joint_rotations()[picked], motion.skeleton, tuple(joint_of)
        )

    def has(self, *names: str) -> bool:
        """Return whether the rig has all these canonical joints."""
        return all(self.joint_of[CANONICAL.index(name)] is not None for name in names)

    def joint(self, name: str) -> int:
        """Return the rig's joint of a canonical one that it has."""
        joint = self.joint_of[CANONICAL.index(name)]
        assert joint is not None
        return joint

    def position(self, name: str) -> Float[Tensor, "poses 3"]:
        """Return the position of a canonical joint that the rig has, metres."""
        return self.positions[:, self.joint(name)]

    def middle(self, part: str) -> Float[Tensor, "poses 3"]:
        """Return the point halfway between the left and the right joint of a part, metres."""
        return (self.position("left" + part) + self.position("right" + part)) / 2

    def across(self, part: str) -> Float[Tensor, "poses 3"]:
        """Return the vector from the right joint of a part to the left, metres."""
        return self.position("left" + part) - self.position("right" + part)

    def up(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector from the thighs to the upper arms."""
        return unit_vectors(self.middle("UpperArm") - self.middle("UpperLeg"))

    def left(self) -> Float[Tensor, "poses 3"]:
        """Return the unit vector along the hip line to the left, square to `up`."""
        across = self.side_line("UpperLeg")
        return unit_vectors(across - self.up() * (across * self.up()).sum(-1, keepdim=True))

    def side_line(self, part: str) -> Float[Tensor, "poses 3"]:
        """Return the vector from the right joint of a part to the left, metres; by the upper arms where the rig has no
        such joints, as shoulders, or both are at one point."""
        across = self.across(part) if self.has("left" + part, "right" + part) else self.across("UpperArm")
        return across if float(across.norm(dim=-1).mean()) > _POINTS_APART else self.across("UpperArm")

    def bone(self, name: str) -> Float[Tensor, "poses 3"] | None:
        """Return the vector, metres, from a canonical joint to the next one of its limb or trunk that the rig has, or
        to its End Site; None where the rig lacks either end, or the End Site is where the joint is."""
        if not self.has(name):
            return None
        following, start = next_joint(name), self.position(name)
        while following is not None and not self.has(following):
            following = next_joint(following)
        if following is not None:
            return self.position(following) - start
        joint = self.joint(name)
        site = self.skeleton.end_offsets.get(self.skeleton.names[joint])
        if site is None or max(map(abs, site)) < 1e-4:
            return None
        return start + rotations.rotate(self.orientations[:, joint], start.new_tensor(site)) - start


def next_joint(name: str) -> str | None:
    """Return the canonical joint that a bone leads to: the knee for the thigh; None for hips and ends of limbs."""
    below = {"spine": "chest", "chest": "neck", "neck": "head"}
    if name in ("hips", *below):
        return below.get(name)
    children = CANONICAL.children(CANONICAL.index(name))
    return CANONICAL.names[children[0]] if children else None


def unit_vectors(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Scale vectors to length 1; a vanishing one stays zero."""
    return torch.nn.functional.normalize(vectors, dim=-1, eps=1e-9)


CONTRADICTION = math.radians(75)
"""Angle between two readings of a joint from which one of them is wrong. Rigs orient joints in quarter turns; hinge
axes of real rigs are up to 53 degrees off their T-pose's (MakeHuman's knees, MocapNET's elbows)."""
CORE = ("hips", "chest", *(side + part for side in ("left", "right") for part in ("UpperLeg", "LowerLeg")))
"""Joints that positions and knees determine beyond doubt: a T-pose that contradicts one of them is none."""
_ARM = ("Shoulder", "UpperArm", "LowerArm", "Hand")
# Knees of standing people are up to 7 degrees past straight, which shows no hinge axis.
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
        matrices = rotations.to_matrix(tpose)
        angles = {name: _angle_between(frame, matrices[CANONICAL.index(name)]) for name, frame in self.certain.items()}
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
    certain: dict[str, Tensor] = field(default_factory=dict)
    """Those of the joints that rigid offsets and bends determine, the hips by the spine."""

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
        """Give a joint the frame in which the first direction is its canonical one, and the second nearly so."""
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

    def be_certain(self, *names: str) -> None:
        """Take the frames that joints have now as certain."""
        self.certain |= {name: self.frames[name] for name in names}

    def orient_joints(self, pitch: float) -> None:
        """Orient all joints, feet with this pitch while they are flat."""
        clip = self.clip
        # Files disagree by 33 degrees about where the spine is over the hips: enough to show which pelvis is wrong.
        self.orient("hips", clip.side_line("UpperLeg"), _X, clip.position("spine") - clip.middle("UpperLeg"), _Y)
        self.be_certain("hips")
        self._orient_trunk()
        for side, sign in SIGNS:
            self._orient_arm(side, sign)
            self._orient_leg(side, pitch)

    def _orient_trunk(self) -> None:
        clip = self.clip
        # The pelvis is up against the legs where both are stretched, else along the spine.
        (left, first), (right, second) = (_leg_extension(clip, side) for side, _ in SIGNS)
        along_spine = unit_vectors(clip.position("spine") - clip.middle("UpperLeg"))
        up = _SPINE_WEIGHT * along_spine - first * second * (left + right)
        self.orient("hips", clip.side_line("UpperLeg"), _X, up, _Y)
        top, across = "spine", clip.side_line("Shoulder")
        if clip.has("chest"):
            self.orient("chest", across, _X, _bone(clip, "chest", clip.up()), _Y)
            top, across = "chest", self.axis("chest", _X)
            self.be_certain("chest")
        self.orient("spine", _bone(clip, "spine", clip.up()), _Y, self.axis("hips", _X) + across, _X)
        for name in filter(clip.has, ("neck", "head")):
            up = self.axis(top, _Y)
            bone = _bone(clip, name, up)
            bone = bone if float((bone * up).sum(-1).mean()) > _HEAD_UP else up
            self.orient(name, bone, _Y, self.axis(top, _X), _X)
        if clip.has("head"):
            self.continue_frame("head", "neck")

    def _orient_arm(self, side: str, sign: float) -> None:
        """Orient the joints of an arm: bones lie along x, the elbow bends toward +z."""
        clip, above = self.clip, "chest" if self.clip.has("chest") else "spine"
        shoulder, upper, lower, hand = (side + part for part in _ARM)
        if clip.has(shoulder):
            bone = _bone(clip, shoulder, sign * self.axis(above, _X))
            self.orient(shoulder, bone, sign * _X, self.axis(above, _Y), _Y)
            above = shoulder
            self.be_certain(shoulder)
        arm = _bone(clip, upper)
        forearm = _bone(clip, lower, arm)
        hinge = -sign * torch.linalg.cross(arm, forearm)
        bends = self.is_hinge(upper, hinge)
        # An arm that stays straight has no more twist against the body than the shortest arc from the T-pose gives it.
        arc = rotations.between_vectors(sign * self.axis(above, _X), arm)
        self.orient(upper, arm, sign * _X, hinge if bends else rotations.rotate(arc, self.axis(above, _Y)), _Y)
        self.orient(lower, forearm, sign * _X, hinge if bends else self.axis(upper, _Y), _Y)
        if clip.has(hand):
            self.orient(hand, _bone(clip, hand, forearm), sign * _X, self.axis(lower, _Y), _Y)
            self.continue_frame(hand, lower)
        if bends:
            self.be_certain(upper)

    def _orient_leg(self, side: str, pitch: float) -> None:
        """Orient the joints of a leg: bones lie along -y, the knee bends toward -z, the foot is as when it is flat."""
        clip = self.clip
        upper, lower, foot, toes = (side + part for part in ("UpperLeg", "LowerLeg", "Foot", "Toes"))
        thigh, shin = _bone(clip, upper), _bone(clip, lower)
        hinge = torch.linalg.cross(thigh, shin)
        bends = self.is_hinge(upper, hinge)
        hinge = hinge if bends else self.axis("hips", _X)
        self.orient(upper, thigh, -_Y, hinge, _X)
        self.orient(lower, shin, -_Y, hinge, _X)
        if bends:
            self.be_certain(upper, lower)
        bone, across = clip.bone(foot), self.axis(lower, _X)
        if bone is None:  # nothing but the shin shows where the foot points
            self.orient(foot, shin, -_Y, across, _X)
        else:
            flat = torch.tensor([0.0, -math.sin(pitch), math.cos(pitch)], dtype=torch.float64)
            self.orient(foot, bone, flat, across, _X)
            if self.in_quarter_turns and _angle_between(self.frames[foot], self.measured[foot]) > _ROUNDING:
                # The foot's axes are along its sole, not along its bone.
                bone = unit_vectors(bone)
                level = math.cos(pitch) * bone + math.sin(pitch) * torch.linalg.cross(bone, unit_vectors(across))
                self.orient(foot, level, _Z, across, _X)
        if clip.has(toes):
            self.orient(toes, self.axis(foot, _X), _X, self.axis(foot, _Y), _Y)


def estimate_frames(
    clip: RigPoses, upright: Float[Tensor, "4"] | None, own: Float[Tensor, "rigged 4"] | None = None
) -> Anatomy:
    """Estimate the frames of all joints that the rig has; `upright` takes the file's world to one with Y up.

    Where the axes of all joints of CORE are near the canonical ones, the rig is built in quarter turns, and its joints
    are rounded to them. `own` is the rotation (xyzw) of each joint's own axes in the file against those of the poses.
    """
    turns, pitch = rotations.to_matrix(clip.orientations), _estimate_foot_pitch(clip, upright)
    axes = torch.eye(3, dtype=turns.dtype).expand_as(turns[0]) if own is None else rotations.to_matrix(own)
    found = _Builder(clip, turns if own is None else turns @ axes)
    found.orient_joints(pitch)
    certain = found.certain
    core = [found.frames[name] for name in CORE if clip.has(name)]
    if all(_angle_between(frame, torch.stack([_nearest_axis(axis) for axis in frame])) < _ROUNDING for frame in core):
        found = _Builder(clip, found.turns, in_quarter_turns=True)
        found.orient_joints(pitch)
    frames = found.frames
    if own is not None:
        frames, certain = (
            {name: frame @ axes[clip.joint(name)].T for name, frame in some.items()} for some in (frames, certain)
        )
    return Anatomy(frames, certain, found.in_quarter_turns)


def _leg_extension(clip: RigPoses, side: str) -> tuple[Vectors, Float[Tensor, "poses 1"]]:
    """Return the unit vector from hip to ankle, and how stretched the leg is: about 1 where it stands, 0 where not."""
    hip, knee, ankle = (clip.position(side + part) for part in ("UpperLeg", "LowerLeg", "Foot"))
    length = (knee - hip).norm(dim=-1) + (ankle - knee).norm(dim=-1)
    extension = (ankle - hip).norm(dim=-1) / length.clamp_min(1e-9)
    return unit_vectors(ankle - hip), (extension**_STRAIGHT_POWER)[:, None]


def _estimate_foot_pitch(clip: RigPoses, upright: Tensor | None) -> float:
    """Estimate how far foot bones point below level while feet are flat, radians; the canonical ones' by default."""
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
    if otherwise is not None and (bone is None or float(bone.norm(dim=-1).mean()) < _POINTS_APART):
        return otherwise
    assert bone is not None
    return unit_vectors(bone)


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


_MAX_LENGTH_RATIO = 1.2  # ratio of the lengths of two bones of one pair
_MIN_REACH_SHARE = 0.25  # of the reach of the joint that they hang from, below which two branches are no limbs
_MAX_SIDE_RATIO = 1.6  # of the lengths of two bones of one pair; performers are not the same on both sides

LimbPair = tuple[list[int], list[int]]
"""The joints of the two limbs of a pair, side by side, from the body outward."""


def match_by_tree(skeleton: Skeleton) -> Mapping[str, int]:
    """Match canonical joint names to the rig's joints, as far as the tree shows; empty where it is no human body's.

    Sides are arbitrary: which limb of a pair is the left one has to be decided by names or positions.
    """
    tree = JointTree(skeleton)
    for hips in range(skeleton.num_joints):
        for legs in tree.find_limb_pairs(hips):
            others = [child for child in tree.children[hips] if child not in (legs[0][0], legs[1][0])]
            for trunk in sorted(others, key=lambda child: -tree.reach[child]):
                chests = [trunk]
                for chest in chests:  # parents first
                    chests += tree.children[chest]
                    arms = tree.find_limb_pairs(chest)
                    if arms:
                        return tree.name_joints(hips, legs, chest, arms[0])
    return {}


class JointTree:
    """Children, bone lengths and reaches of a skeleton's joints; a reach is the length of the longest chain below."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self.children = [skeleton.children(joint) for joint in range(skeleton.num_joints)]
        self.length = skeleton.offsets.norm(dim=-1).tolist()
        ends = {skeleton.index(name): torch.tensor(site).norm().item() for name, site in skeleton.end_offsets.items()}
        self.reach = [0.0] * skeleton.num_joints
        for joint in reversed(range(skeleton.num_joints)):
            below = [self.length[child] + self.reach[child] for child in self.children[joint]]
            self.reach[joint] = max([ends.get(joint, 0.0), *below])

    def find_limb_pairs(self, joint: int) -> list[LimbPair]:
        """Find branches that are a pair of limbs, bone for bone of about the same length; the longest pair first."""
        found = []
        for first, second in combinations(self.children[joint], 2):
            paths = [first], [second]
            while True:  # down as long as they are alike; a sword in one hand is not
                ends = product(self.children[paths[0][-1]], self.children[paths[1][-1]])
                steps = [(a, b) for a, b in ends if are_alike(self.length[a], self.length[b], _MAX_LENGTH_RATIO)]
                if not steps:
                    break
                best = max(steps, key=lambda step: min(self.reach[joint] + self.length[joint] for joint in step))
                for path, below in zip(paths, best, strict=True):
                    path.append(below)
            long = sum(self.length[below] for below in paths[0][1:])
            far = long >= _MIN_REACH_SHARE * self.reach[joint]
            if far and len(paths[0]) >= 3 and are_alike(self.length[first], self.length[second], _MAX_LENGTH_RATIO):
                found.append((-long, paths))
        return [paths for _, paths in sorted(found)]

    def name_joints(self, hips: int, legs: LimbPair, chest: int, arms: LimbPair) -> dict[str, int]:
        """Name the joints of a body with these legs and arms."""
        found = {"hips": hips}
        for side, leg, arm in zip(("left", "right"), legs, arms, strict=True):
            found |= self._name_limb(leg, [side + part for part in ("", "UpperLeg", "LowerLeg", "Foot", "Toes")])
            found |= self._name_limb(arm, [side + part for part in ("Shoulder", "UpperArm", "LowerArm", "Hand", "")])
        trunk = path_below(self.skeleton, hips, chest)
        if trunk:
            found["spine"] = trunk[0]
        if len(trunk) > 1:
            found["chest"] = trunk[-1]
        others = [child for child in self.children[chest] if child not in (arms[0][0], arms[1][0])]
        if others:
            neck = max(others, key=lambda child: self.reach[child])
            head = max(self.children[neck], key=lambda child: self.length[child] + self.reach[child], default=None)
            found |= {"head": neck} if head is None else {"neck": neck, "head": head}
        return found

    def _name_limb(self, path: list[int], names: list[str]) -> dict[str, int]:
        """Name a limb's joints: the second and third begin its two longest bones; a bare side is no name."""
        both = [self.length[path[k + 1]] + self.length[path[k + 2]] for k in range(len(path) - 2)]
        upper = max(range(len(both)), key=both.__getitem__)
        placed = {name: upper + k - 1 for k, name in enumerate(names)}
        return {name: path[at] for name, at in placed.items() if len(name) > 5 and 0 <= at < len(path)}


def are_alike(first: float, second: float, ratio: float) -> bool:
    """Return whether two lengths, metres, differ by no more than a ratio."""
    short, long = sorted((first, second))
    return long <= ratio * short + 1e-6


def find_by_other_side(skeleton: Skeleton, found: Mapping[str, int]) -> dict[str, int]:
    """Find canonical joints that only the other side has so far, from the hips outward."""
    more: dict[str, int] = {}
    lengths = skeleton.offsets.norm(dim=-1).tolist()
    for name in CANONICAL.names:
        known = {**found, **more}
        above = CANONICAL.names[CANONICAL.parents[CANONICAL.index(name)]] if name != "hips" else name
        needed = (mirror_name(name), above, mirror_name(above))
        if name in known or mirror_name(name) == name or not all(one in known for one in needed):
            continue
        path = path_below(skeleton, known[mirror_name(above)], known[mirror_name(name)])
        if not path:
            continue
        ends = [known[above]]  # of paths whose bones are as long as those of the other side's
        for joint in path:
            below = [child for end in ends for child in skeleton.children(end)]
            ends = [child for child in below if are_alike(lengths[joint], lengths[child], _MAX_SIDE_RATIO)]
        parts = {CANONICAL.names[joint] for joint in descendants(CANONICAL, {CANONICAL.index(name)})}
        below = [known[part] for part in parts & known.keys()]
        free = [end for end in ends if end not in known.values()]
        fitting = [end for end in free if all(path_below(skeleton, end, joint) for joint in below)]
        if fitting:
            size = len(descendants(skeleton, {known[mirror_name(name)]}))
            more[name] = min(fitting, key=lambda end: abs(len(descendants(skeleton, {end})) - size))
    return more


def descendants(skeleton: Skeleton, joints: Collection[int]) -> set[int]:
    """Return joints and all below them."""
    found = set(joints)
    for child, parent in enumerate(skeleton.parents):
        if parent in found:
            found.add(child)
    return found


def ancestors(skeleton: Skeleton, joints: Collection[int]) -> set[int]:
    """Return joints and all above them."""
    found = set(joints)
    for child in reversed(range(1, skeleton.num_joints)):
        if child in found:
            found.add(skeleton.parents[child])
    return found


def path_below(skeleton: Skeleton, above: int, joint: int) -> list[int]:
    """Return the joints below `above` down to a joint, and that joint; none where it does not hang from it."""
    path = []
    while joint >= 0 and joint != above:
        path.append(joint)
        joint = skeleton.parents[joint]
    return path[::-1] if joint == above else []
