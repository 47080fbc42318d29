"""Doubts about the identification of a rig: each reason in a sentence, with its joints.

Names, tree and bones are to be those of one two-legged person, and the T-pose is to agree with the clip.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, product

import torch

from mapctl import rotations
from mapctl.formats.units import FileUnit
from mapctl.joint_names import Part, Side
from mapctl.joint_roles import classify_joints
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.anatomy import (
    MIN_FRONT,
    SIGNS,
    RigPoses,
    find_further_limbs,
    find_second_body,
    measure_front,
    path_below,
    stays_on_all_fours,
)
from mapctl.retarget.character import SIDES
from mapctl.retarget.joint_matching import HELPER_NAME, KnownBy
from mapctl.skeleton import CANONICAL, LIMBS, mirror_name

_MAX_LISTED = 4  # joints that have a line each; of more there is one line
_MAX_SPEED = 12.0  # m/s of the hips, median over a second, of people on foot
_LIMBS = ("LowerArm", "Hand", "LowerLeg", "Foot")
_PARTS = {
    "hips": {Part.HIPS},
    "spine": {Part.TORSO},
    "chest": {Part.TORSO},
    "neck": {Part.NECK, Part.TORSO},
    "head": {Part.HEAD, Part.NECK},
    "Shoulder": {Part.SHOULDER},
    "UpperArm": {Part.UPPER_ARM, Part.SHOULDER},
    "LowerArm": {Part.LOWER_ARM, Part.UPPER_ARM},
    "Hand": {Part.HAND},
    "UpperLeg": {Part.UPPER_LEG, Part.HIPS, Part.LOWER_LEG},
    "LowerLeg": {Part.LOWER_LEG, Part.UPPER_LEG},
    "Foot": {Part.FOOT},
    "Toes": {Part.TOES, Part.FOOT},
}
_HALVES = (0.5, 2.0)  # of an upper limb's bone by the lower one
_SIDE_RATIO = 1.2  # of a bone by that of the other side
_MIN_DIFFERENCE = 0.02  # metres by which bones of both sides differ at least, to differ
_ARM_BY_LEG = (0.35, 1.4)
_TRUNK_BY_LEG = (0.25, 1.4)
_HIPS_METRES = (0.4, 1.6)  # metres of the hips over the toes, of people
_MAX_SINK = 0.03  # metres that a joint of the trunk may be under the one before
_NO_BONE = 0.01  # metres of a bone that is none
_UPRIGHT = 0.5  # cosine between a body and the vertical, below which it lies


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt that a rig was understood."""

    reason: str
    """The reason, a sentence without a full stop."""
    joints: tuple[str, ...] = ()
    """Canonical joints that it is about; empty where it is about the whole body."""


@dataclass(frozen=True)
class Fit:
    """Whether a rig's understanding can be relied on."""

    doubts: tuple[Doubt, ...]
    """Doubts, the gravest first; empty for a sure fit."""

    @property
    def verdict(self) -> str:
        """`sure` where nothing is doubtful, else `doubtful`."""
        return "doubtful" if self.doubts else "sure"

    @property
    def joints(self) -> frozenset[str]:
        """Canonical joints that some doubt is about."""
        return frozenset(joint for doubt in self.doubts for joint in doubt.joints)


def assess_fit(rigmap: RigMap, motion: Motion | None = None) -> Fit:
    """Assess how sure it is that a rig was understood, by its names, its tree, its bones and a motion of it."""
    zero = RigPoses.zero(rigmap.rig_skeleton, rigmap.joint_of)
    clip = None if motion is None else RigPoses.of(motion, rigmap.joint_of)
    return Fit(
        (
            *(() if motion is None else _check_unit(rigmap, motion)),
            *_find_other_bodies(rigmap, clip or zero),
            *_compare_sides(rigmap, zero, clip or zero),
            *_check_names(rigmap),
            *_check_bones(RigPoses.zero(rigmap.skeleton)),
            *(() if clip is None else _check_poses(rigmap, clip)),
        )
    )


def _check_unit(rigmap: RigMap, motion: Motion) -> Iterator[Doubt]:
    """Check the unit that was found by the size of the body, and the speed that results from a unit."""
    if isinstance(motion.source, FileUnit) and motion.source.unit_doubt:
        yield Doubt(motion.source.unit_doubt)
    travel = motion.joint_positions()[:, rigmap.joints["hips"]].diff(dim=0).norm(dim=-1) * float(motion.fps)
    second = max(1, round(float(motion.fps)))
    if len(travel) >= second:
        fastest = float(travel.unfold(0, second, second).median(dim=-1).values.max())
        if fastest > _MAX_SPEED:
            yield Doubt(f"the hips travel at {fastest:.0f} m/s for a second: the unit may be wrong")


def _find_other_bodies(rigmap: RigMap, poses: RigPoses) -> Iterator[Doubt]:
    """Find a second body, a second pair of arms, and joints that do not hang from the one before in limb or trunk."""
    joints, tree = rigmap.joints, rigmap.rig_skeleton
    other = find_second_body(poses, joints)
    if other is not None:
        yield Doubt(f"another body is in the file, with hips {_quote(rigmap, other)}; only one is used", ("hips",))
    if any(how is not KnownBy.LIST for how in rigmap.match.known_by.values()):
        pair = find_further_limbs(tree, joints)
        if pair is not None:
            names = " and ".join(_quote(rigmap, joint) for joint in pair)
            yield Doubt(f"a further pair of limbs hangs from the trunk: {names}", ("leftUpperArm", "rightUpperArm"))
    for name, joint in joints.items():
        above = _find_above(rigmap, name)
        if above is not None and not path_below(tree, joints[above], joint):
            upper = _quote(rigmap, joints[above])
            yield Doubt(f"{name} {_quote(rigmap, joint)} does not hang from {above} {upper}", (name,))


def _find_above(rigmap: RigMap, name: str) -> str | None:
    """Return the first joint of the rig over a canonical one in its limb, or in the trunk over the hips; or None."""
    above = CANONICAL.names[CANONICAL.parents[CANONICAL.index(name)]] if name != "hips" else name
    if above == "hips" or _split(above)[0] != _split(name)[0]:
        return None
    return above if above in rigmap.joints else _find_above(rigmap, above)


def _compare_sides(rigmap: RigMap, zero: RigPoses, poses: RigPoses) -> Iterator[Doubt]:
    """Compare the sides that names have with each other and with those that toes and knees show."""
    exchanged = rigmap.match.sides_exchanged
    if exchanged:
        yield Doubt("joints called left are on the right, by toes and knees; positions outweigh names")
    roles = classify_joints(rigmap.rig_skeleton)
    named = [name for name, joint in rigmap.joints.items() if roles[joint].side is not Side.MIDDLE]
    for name in named:
        side = roles[rigmap.joints[name]].side.value
        if not name.startswith(mirror_name(side) if exchanged else side):
            yield Doubt(f"{name} is {_quote(rigmap, rigmap.joints[name])}, a name of the other side", (name,))
    turned = torch.nn.functional.cosine_similarity(poses.across("UpperArm"), poses.across("UpperLeg"), dim=-1)
    if float(turned.median()) < -MIN_FRONT:
        yield Doubt("the left arm is on the side of the right leg", ("leftUpperArm", "rightUpperArm"))
    if not named and max(abs(float(measure_front(each).mean())) for each in (zero, poses)) < MIN_FRONT:
        yield Doubt("nothing shows the front: no names of sides, no toes; left may be right")


def _check_names(rigmap: RigMap) -> Iterator[Doubt]:
    """Check for joints known by position alone, beside a skipped one, by other names than partners, on one side."""
    joints, known, names = rigmap.joints, rigmap.match.known_by, rigmap.rig_skeleton.names
    quoted = {name: _quote(rigmap, joint) for name, joint in joints.items()}
    placed = [name for name, how in known.items() if how is KnownBy.POSITION]
    if len(placed) <= _MAX_LISTED:
        for name in placed:
            yield Doubt(f"{name} is known by its position alone (joint {quoted[name]})", (name,))
    else:
        listed = ", ".join(f"{name} ({quoted[name]})" for name in placed[:_MAX_LISTED])
        more = len(placed) - _MAX_LISTED
        yield Doubt(f"{len(placed)} joints are known by their positions alone: {listed} and {more} more", (*placed,))
    roles = classify_joints(rigmap.rig_skeleton)
    for name in placed:
        part = roles[joints[name]].part
        if part is not Part.OTHER and part not in _PARTS[_split(name)[1]]:
            yield Doubt(f"{name} is {quoted[name]}, whose name is that of a {part.value}", (name,))
    # Joints but twists and other helpers between chest and arms, or within a limb of which no list has the next joint.
    skipped = set[int]()
    for name, joint in joints.items():
        side, part = _split(name)
        first = part == "Shoulder" or (part == "UpperArm" and side + "Shoulder" not in joints)
        above = "chest" if first else _find_above(rigmap, name) if part in _LIMBS else None
        if above not in joints or (above != "chest" and known[name] is KnownBy.LIST):
            continue
        between = path_below(rigmap.rig_skeleton, joints[above], joint)[-2::-1]
        between = [one for one in between if one not in joints.values() and not HELPER_NAME.search(names[one])]
        if between and between[0] not in skipped:
            middle = _quote(rigmap, between[0])
            yield Doubt(f"between {above} {quoted[above]} and {name} {quoted[name]} is {middle}", (above, name))
        skipped |= {*between}
    for name in joints:
        other = mirror_name(name)
        version, usual = _find_version(rigmap, name), _find_version(rigmap, other)
        if other in joints and version is not None and usual is not None and version > usual:
            theirs = quoted[other]
            yield Doubt(f"{name} is {quoted[name]} and {other} is {theirs}, which is named otherwise", (name,))
    for name in ("head", "leftHand", "rightHand"):
        if name not in joints and mirror_name(name) not in joints:
            yield Doubt(f"no joint is known for {name}", (name,))
    for name in joints:
        if (other := mirror_name(name)) not in joints:
            yield Doubt(f"{other} is missing, {name} is there", (other, name))


def _find_version(rigmap: RigMap, name: str) -> int | None:
    """Return the version of the rig's list that has the name of a joint, or one more than any where words show it;
    None where it is spelled otherwise or known by its position."""
    rig, how = rigmap.rig, rigmap.match.known_by.get(name)
    listed = (rig.joints.get(name), *rig.aliases.get(name, ()))
    if how is KnownBy.WORDS and name in rig.joints:
        return len(listed)
    own = rigmap.joint_names.get(name)
    return listed.index(own) if how is KnownBy.LIST and own in listed else None


def _split(name: str) -> tuple[str, str]:
    """Split a canonical name into its side, if it has one, and its part."""
    side = next((side for side in SIDES if name.startswith(side)), "")
    return side, name.removeprefix(side)


def _quote(rigmap: RigMap, joint: int) -> str:
    return repr(rigmap.rig_skeleton.names[joint])


def _check_bones(body: RigPoses) -> Iterator[Doubt]:
    """Check lengths of limbs, of both sides, of arms and trunk against legs; and what is over and beside what."""
    length = dict(zip(CANONICAL.names, body.skeleton.offsets.norm(dim=-1).tolist(), strict=True))
    for side, (limb, *parts) in product(SIDES, (("arm", "LowerArm", "Hand"), ("leg", "LowerLeg", "Foot"))):
        joints = (side + parts[0], side + parts[1])
        halves = [length[joint] for joint in joints]
        if min(halves) < _NO_BONE:
            yield Doubt(f"{min(joints, key=length.__getitem__)} is at the position of the joint above it", joints)
        elif not _HALVES[0] <= halves[0] / halves[1] <= _HALVES[1]:
            centimetres = " and ".join(f"{100 * half:.0f} cm" for half in halves)
            yield Doubt(f"the {side} {limb} has halves of {centimetres}", joints)
    for name in CANONICAL.names:
        if name.startswith("left") and not name.endswith(("Toes", "Shoulder")):
            other = mirror_name(name)
            short, long = sorted((length[name], length[other]))
            if long > _SIDE_RATIO * short and long - short > _MIN_DIFFERENCE:
                found = f"{100 * length[name]:.0f} and {100 * length[other]:.0f} cm"
                yield Doubt(f"the bones to {name} and {other} differ: {found}", (name, other))

    def over_hips(name: str, below: str = "hips") -> list[float]:
        return (body.position(name) - body.position(below))[0].tolist()

    leg, arm = (sum(LIMBS[side + end].length(body.skeleton) for side in SIDES) / 2 for end in ("Foot", "Hand"))
    if leg >= _NO_BONE:
        trunk = float((body.middle("UpperArm") - body.position("hips")).norm())
        for name, own, allowed in (("arms are", arm, _ARM_BY_LEG), ("trunk is", trunk, _TRUNK_BY_LEG)):
            if not allowed[0] <= own / leg <= allowed[1]:
                yield Doubt(f"{name} {100 * own:.0f} cm long and legs {100 * leg:.0f} cm")
        height = max(over_hips("hips", side + "Toes")[1] for side in SIDES)
        if not _HIPS_METRES[0] <= height <= _HIPS_METRES[1]:
            yield Doubt(f"hips are {height:.2f} m over the toes: the unit may be wrong")
    for below, above in pairwise(("hips", "spine", "chest", "neck", "head")):
        if over_hips(above, below)[1] < -_MAX_SINK:
            yield Doubt(f"{above} is below {below} in the T-pose", (below, above))
    for side, sign in SIGNS:
        if over_hips(side + "UpperArm")[1] < 0:
            yield Doubt(f"{side}UpperArm is below the hips in the T-pose", (side + "UpperArm",))
        for part in ("UpperArm", "UpperLeg"):
            if sign * over_hips(side + part)[0] < -_NO_BONE:
                yield Doubt(f"{side + part} is on the other side of the hips", (side + part,))


def _check_poses(rigmap: RigMap, clip: RigPoses) -> Iterator[Doubt]:
    """Check what a clip shows: an upright body, and a T-pose that agrees with it."""
    up = clip.up()
    if rigmap.upright_quat_xyzw is not None:
        up = rotations.rotate(rigmap.upright_quat_xyzw.expand(len(up), 4), up)
    if stays_on_all_fours(clip):
        yield Doubt("hands stand beside the feet under a level trunk in the whole clip: this may be an animal")
    elif float(up[:, 1].median()) < _UPRIGHT:
        yield Doubt(f"the body lies or hangs upside down in most frames if {rigmap.up} is up")
    if rigmap.tpose_doubt:
        yield Doubt(rigmap.tpose_doubt)
