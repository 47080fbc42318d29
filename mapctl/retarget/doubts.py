"""Doubts about the identification of a rig: each reason in a sentence, with its joints.

Names, tree and bones are to be those of one two-legged person, and the T-pose is to agree with the clip.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch

from mapctl import rotations
from mapctl.formats.units import FileUnit
from mapctl.joint_names import Side
from mapctl.joint_roles import classify_joints
from mapctl.motion import Motion
from mapctl.retarget import RigMap
from mapctl.retarget.anatomy import (
    MIN_FRONT,
    RigPoses,
    ancestors,
    descendants,
    match_by_tree,
    measure_front,
    path_below,
)
from mapctl.retarget.character import SIDES, TOES
from mapctl.retarget.joint_matching import HELPER_NAME, KnownBy
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

_MAX_LISTED = 4  # joints that have a line each; of more there is one line
_MAX_SPEED = 12.0  # m/s of the hips, median over a second, of people on foot
_LIMBS = ("LowerArm", "Hand", "LowerLeg", "Foot")
_SIDE_RATIO = 1.2  # of a bone by that of the other side
_MIN_DIFFERENCE = 0.02  # metres by which bones of both sides differ at least, to differ
_PROPORTION = 2.2  # by which a bone or the trunk is longer or shorter than the canonical one, of the legs' length
_HIPS_METRES = (0.4, 1.6)  # metres of the hips over the toes, of people
_ASIDE = 0.05  # metres from the canonical hips, from which a joint has a side of them
_NO_BONE = 0.01  # metres that are none
_BODIES_APART = 0.1  # metres between the hips of two bodies
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
            *_check_tree(rigmap, clip or zero),
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


def _check_tree(rigmap: RigMap, poses: RigPoses) -> Iterator[Doubt]:
    """Check for a second body, and for joints that do not hang from the one before in limb or trunk."""
    joints = rigmap.joints
    other = _find_second_body(poses, joints)
    if other is not None:
        yield Doubt(f"another body is in the file, with hips {_quote(rigmap, other)}; only one is used", ("hips",))
    for name, joint in joints.items():
        above = _find_above(rigmap, name)
        if above is not None and not path_below(rigmap.rig_skeleton, joints[above], joint):
            upper = _quote(rigmap, joints[above])
            yield Doubt(f"{name} {_quote(rigmap, joint)} does not hang from {above} {upper}", (name,))


def _find_second_body(poses: RigPoses, joints: Mapping[str, int]) -> int | None:
    """Find the hips of another body in the file than the one that is matched, by its tree; None where there is none.

    A second set of joints in the same position, as the controls of a rig are, is no other body.
    """
    skeleton = poses.skeleton
    near = descendants(skeleton, joints.values()) | ancestors(skeleton, joints.values())
    rest = [joint for joint in range(skeleton.num_joints) if joint not in near]
    index_of = {joint: number for number, joint in enumerate([-1, *rest])}
    parents = (-1, *(index_of.get(skeleton.parents[joint], 0) for joint in rest))
    offsets = torch.cat([torch.zeros(1, 3, dtype=skeleton.offsets.dtype), skeleton.offsets[rest]])
    ends = {name: end for name, end in skeleton.end_offsets.items() if skeleton.index(name) in index_of}
    other = match_by_tree(Skeleton(("", *(skeleton.names[j] for j in rest)), parents, offsets, ends))
    if "hips" not in other or other["hips"] == 0:
        return None
    hips = rest[other["hips"] - 1]
    apart = (poses.positions[:, hips] - poses.positions[:, joints["hips"]]).norm(dim=-1).mean()
    return hips if float(apart) > _BODIES_APART else None


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
    """Check proportions, both sides, and what is over and beside the hips in the T-pose, by the canonical body."""
    canonical = RigPoses.zero(CANONICAL)
    length, usual = _measure_lengths(body), _measure_lengths(canonical)
    for name in ("trunk", *(side + part for side in SIDES for part in _LIMBS)):
        ratio = (length[name] / usual[name]) / max(length["legs"] / usual["legs"], _NO_BONE)
        if not 1 / _PROPORTION <= ratio <= _PROPORTION:
            what, joints = ("the trunk", ()) if name == "trunk" else (f"the bone to {name}", (name,))
            yield Doubt(f"{what} is {ratio:.1f} times as long as a person's with such legs", joints)
    for name in CANONICAL.names:
        if name.startswith("left") and not name.endswith(("Toes", "Shoulder")):
            other = mirror_name(name)
            short, long = sorted((length[name], length[other]))
            if long > _SIDE_RATIO * short and long - short > _MIN_DIFFERENCE:
                found = f"{100 * length[name]:.0f} and {100 * length[other]:.0f} cm"
                yield Doubt(f"the bones to {name} and {other} differ: {found}", (name, other))
    own, aside = (poses.positions[0] - poses.position("hips")[0] for poses in (body, canonical))
    height = -float(own[TOES, 1].min())
    if not _HIPS_METRES[0] <= height <= _HIPS_METRES[1]:
        yield Doubt(f"hips are {height:.2f} m over the toes: the unit may be wrong")
    wrong = (aside.abs() > _ASIDE) & (own * aside.sign() < -_NO_BONE)
    for joint, axis in wrong[:, :2].nonzero().tolist():
        name, where = CANONICAL.names[joint], ("beside", "above or below")[axis]
        yield Doubt(f"{name} is on the wrong side of the hips in the T-pose, {where} them", (name,))


def _measure_lengths(body: RigPoses) -> dict[str, float]:
    """Measure the bones to each canonical joint, both legs, and from hips to shoulders, metres."""
    length = dict(zip(CANONICAL.names, body.skeleton.offsets.norm(dim=-1).tolist(), strict=True))
    legs = sum(length[side + part] for side in SIDES for part in ("LowerLeg", "Foot"))
    return length | {"legs": legs, "trunk": float((body.middle("UpperArm") - body.position("hips")).norm())}


def _check_poses(rigmap: RigMap, clip: RigPoses) -> Iterator[Doubt]:
    """Check what a clip shows: an upright body, and a T-pose that agrees with it."""
    up = clip.up()
    if rigmap.upright_quat_xyzw is not None:
        up = rotations.rotate(rigmap.upright_quat_xyzw.expand(len(up), 4), up)
    if float(up[:, 1].median()) < _UPRIGHT:
        yield Doubt(f"the body lies, crawls or hangs upside down in most frames if {rigmap.up} is up")
    if rigmap.tpose_doubt:
        yield Doubt(rigmap.tpose_doubt)
