"""Which joint of any rig is which canonical one: by listed names, by the words in names, and by the tree.

Sides are checked by how the body of a clip is built and bends.
"""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import lru_cache

from mapctl.errors import RequestError
from mapctl.joint_names import Part, Role, Side, abbreviate_names, describe_nearest, normalise_name
from mapctl.joint_roles import classify_joints, find_hips
from mapctl.motion import Motion
from mapctl.retarget.anatomy import RigPoses, are_sides_swapped, descendants, find_by_other_side, match_by_tree
from mapctl.retarget.rigs import Rig, known_rigs
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

MIN_SCORE = 0.6
"""Least score with which a rig counts as understood."""
REQUIRED = (
    "hips",
    "spine",
    *(side + part for side in ("left", "right") for part in ("UpperArm", "LowerArm", "UpperLeg", "LowerLeg", "Foot")),
)
"""Canonical joints that a rig must have; the others are put in between or at the end where it lacks them."""

_ABSENT, _SWAPPED = 0.4, 0.9
_ARMS_ON_CHEST = 0.5  # joints that a chest from which the shoulders hang is worth
_MIN_PREFIXED = 5  # joints whose names begin alike, from which this is a prefix
_BEGINNING = re.compile(r"[^_:|.\- ]+[_:|.\- ](?=.)")  # of a name, up to its first separator
HELPER_NAME = re.compile(
    r"(?:^|[:|])__|twist|roll|\bik|ik_|_ik|pole|ctrl|control|nub|_end|\bend|site|tip|prop|weapon|aim|target|"
    r"helper|corrective|attach|socket|skirt|hair|cloth|breast|bust|捩|ＩＫ",
    re.IGNORECASE,
)
"""In names of joints that are no body part's."""


class KnownBy(Enum):
    """Evidence by which a joint is a canonical one."""

    LIST = "list"
    """Its name, which a listed rig or the user's rig names."""
    WORDS = "words"
    """The words of its name: a side and a body part."""
    POSITION = "position"
    """Position in the tree and lengths of the bones alone."""


_CREDIT = {KnownBy.LIST: 1.0, KnownBy.WORDS: 1.0, KnownBy.POSITION: 0.7}


@dataclass(frozen=True)
class Match:
    """Which joint of a skeleton is which canonical one, and how sure that is."""

    rig: Rig
    """The preset that fits or what the user gave; for others a rig by the name of `unlisted` with what was found."""
    joint_of: tuple[int | None, ...]
    """For each canonical joint the rig's joint, None where it has none."""
    score: float
    """Mean over the canonical joints, 0 to 1: 1 for one known by name, 0.7 by its position in the tree alone, 0.4 for
    one that a rig may lack and this one does, 0 for one that it must have; times 0.9 where left and right are
    exchanged."""
    unmapped: tuple[str, ...]
    """Joints of the rig that are no canonical one, as fingers, twists and props."""
    sides_exchanged: bool = False
    """Whether joints named left are on the right."""
    known_by: Mapping[str, KnownBy] = field(default_factory=dict)
    """Evidence for each canonical joint that the rig has."""


def match(skeleton: Skeleton, rig: Rig | None = None, *, motion: Motion | None = None) -> Match:
    """Match a skeleton by the joints of a given rig, else by the presets, or by what it looks like; sides are as named.

    A `motion` shows which arm is on which leg's side where names do not. RequestError where a score of MIN_SCORE is not
    reached or a joint of REQUIRED is not found, naming what is missing.
    """
    given = rig if rig is not None and rig.joints else None
    chosen, found = _find_listed_rig(skeleton) if given is None else (given, _match_by_rig(given, skeleton))
    for name in REQUIRED:
        if given is not None and name in given.joints and name not in found:
            near = describe_nearest(given.joints[name], skeleton.names, classify_joints(skeleton))
            raise RequestError(f"rig {given.name}: no joint {given.joints[name]!r} for {name}; {near}")
    known = dict.fromkeys(found, KnownBy.LIST)
    complete = all(name in found for name in REQUIRED)
    if chosen is None or not complete or (given is None and not chosen.fits(skeleton)):
        found, known = _complete_match(skeleton, found, motion)
    missing = [name for name in REQUIRED if name not in found]
    absent = 0.0 if missing else _ABSENT
    worth = [_CREDIT[known[c]] if c in known else 0.0 if c in REQUIRED else absent for c in CANONICAL.names]
    score = sum(worth) / len(worth)
    if missing or score < MIN_SCORE:
        lacking = ", ".join(missing or (name for name in CANONICAL.names if name not in found))
        others = "" if missing else ", and the names of the others are no body parts"
        names, rigs = abbreviate_names(skeleton.names), ", ".join(rig.name for rig in known_rigs())
        raise RequestError(
            f"the rig is not recognised: no joint is found for {lacking}{others}; its joints are {names}; "
            f"known rigs: {rigs}; a TOML file can name its joints"
        )
    if chosen is None:
        chosen = Rig("unlisted", {name: skeleton.names[joint] for name, joint in found.items()})
    if rig is not None and given is None:
        chosen = chosen.with_fields_of(rig)
    joint_of = tuple(found.get(name) for name in CANONICAL.names)
    unmapped = tuple(name for joint, name in enumerate(skeleton.names) if joint not in found.values())
    return Match(chosen, joint_of, score, unmapped, known_by=known)


def correct_sides(found: Match, zero: RigPoses, clip: RigPoses | None) -> Match:
    """Exchange left and right in the match if the rig's names contradict the positions of its joints."""
    if not are_sides_swapped(zero, clip):
        return found
    partner = [CANONICAL.index(mirror_name(name)) for name in CANONICAL.names]
    joint_of = tuple(found.joint_of[other] for other in partner)
    known = {mirror_name(name): how for name, how in found.known_by.items()}
    named = any(r.side is not Side.MIDDLE for j, r in enumerate(classify_joints(zero.skeleton)) if j in found.joint_of)
    score = found.score * (_SWAPPED if named else 1.0)
    return replace(found, joint_of=joint_of, score=score, sides_exchanged=named, known_by=known)


def _find_listed_rig(skeleton: Skeleton) -> tuple[Rig | None, dict[str, int]]:
    """Find the listed rig that explains most of the skeleton, if one has all joints of REQUIRED, and its joints."""
    fits: list[tuple[float, Rig, dict[str, int]]] = []
    plain = {normalise_name(name) for name in skeleton.names}
    for rig in known_rigs():
        found = _match_by_rig(rig, skeleton)
        complete = all(name in found for name in REQUIRED)
        if complete and (rig.name != "canonical" or rig.fits(skeleton)):
            fits.append((_measure_fit(rig, found, skeleton, plain), rig, found))
    return max(fits, key=lambda fit: fit[0])[1:] if fits else (None, {})


def _match_by_rig(rig: Rig, skeleton: Skeleton) -> dict[str, int]:
    """Match joints by a rig's names, in the version that fits best; spelling and prefixes count where they must."""
    exact, plain = {name: joint for joint, name in enumerate(skeleton.names)}, dict[str, int]()
    for spelled in (skeleton.names, without_shared_prefix(skeleton.names)):  # whole names come first
        for joint, name in enumerate(spelled):
            plain.setdefault(normalise_name(name), joint)
    listed = {c: (own, *rig.aliases.get(c, ())) for c, own in rig.joints.items()}
    joint_of = {name: exact.get(name, plain.get(normalise_name(name))) for names in listed.values() for name in names}

    best: dict[str, int] = {}
    versions = 1 + max((len(others) for others in rig.aliases.values()), default=0)
    for version in range(versions):
        found: dict[str, int] = {}
        for first in (True, False):
            for canonical, names in listed.items():
                tried = [names[min(version, len(names) - 1)]] if first else names
                hits = [hit for hit in map(joint_of.get, tried) if hit is not None and hit not in found.values()]
                if hits and canonical not in found:
                    found[canonical] = hits[0]
        if len(found) > len(best):
            best = found
    return best


@lru_cache(maxsize=8)
def without_shared_prefix(names: tuple[str, ...]) -> list[str]:
    """Return the names without what most of them begin with, up to a separator: `Skeleton0_Hips` is `Hips`."""
    beginnings = [match[0] for match in map(_BEGINNING.match, names) if match]
    (most, count), *_ = Counter(beginnings).most_common(1) or [("", 0)]
    if count <= max(_MIN_PREFIXED, len(names) / 2):
        return list(names)
    return without_shared_prefix(tuple(name.removeprefix(most) for name in names))


def _measure_fit(rig: Rig, found: Mapping[str, int], skeleton: Skeleton, plain: set[str]) -> float:
    """Measure how well a rig explains a skeleton: joints it names, and below one joint what distinguishes relatives."""
    extra = {normalise_name(name) for name in (*rig.also, *rig.trunk)}
    explained = len(found) + len(extra & plain - {normalise_name(skeleton.names[j]) for j in found.values()})
    lacking = len(rig.joints) - len(found) + len(extra - plain)
    # Fingers and props beyond what a preset lists do not count against it; what it lists and the rig lacks does.
    spelled = sum(skeleton.names[joint] in (rig.joints[c], *rig.aliases.get(c, ())) for c, joint in found.items())
    arms = [found.get(side + "Shoulder", found[side + "UpperArm"]) for side in ("left", "right")]
    carried = _ARMS_ON_CHEST * all(skeleton.parents[arm] == found.get("chest") for arm in arms)
    return len(found) + explained / (explained + lacking) + spelled / len(found) + carried


def _complete_match(
    skeleton: Skeleton, given: Mapping[str, int], motion: Motion | None
) -> tuple[dict[str, int], dict[str, KnownBy]]:
    """Match joints by the words in their names, completed by the tree; also return what each is known by."""
    found = dict(given)
    for name, joint in _match_by_words(skeleton, given.get("hips")).items():
        if joint not in found.values():
            found.setdefault(name, joint)
    known = {name: KnownBy.LIST if name in given else KnownBy.WORDS for name in found}
    beside = find_by_other_side(skeleton, found)
    found, known = found | beside, known | dict.fromkeys(beside, KnownBy.POSITION)
    by_tree = _assign_sides(match_by_tree(skeleton), classify_joints(skeleton), skeleton, motion)
    for name, joint in by_tree.items():
        helper = HELPER_NAME.search(skeleton.names[joint])
        if name not in found and joint not in found.values() and not helper:
            found[name], known[name] = joint, KnownBy.POSITION
    return found, known


def _match_by_words(skeleton: Skeleton, hips: int | None) -> dict[str, int]:
    """Match canonical joints by the side and part in their names, below the hips, top down."""
    if hips is None:
        try:
            hips = find_hips(skeleton)
        except RequestError:
            return {}
    found = {"hips": hips}
    every = classify_joints(skeleton)
    inside = descendants(skeleton, {hips})
    if skeleton.parents[hips] >= 0 and not any(every[joint].part is Part.UPPER_ARM for joint in inside):
        inside = descendants(skeleton, {skeleton.parents[hips]})  # a trunk beside the hips, as MMD has it
    roles = [
        r if j in inside and not HELPER_NAME.search(skeleton.names[j]) else Role(Side.MIDDLE, Part.OTHER)
        for j, r in enumerate(every)
    ]
    for side in (Side.LEFT, Side.RIGHT):
        found |= _match_limb_by_words(roles, side)
    arms = [found[name] for name in ("leftUpperArm", "rightUpperArm") if name in found]
    trunk = [j for j, r in enumerate(roles) if r == Role(Side.MIDDLE, Part.TORSO)]
    holding = [j for j in trunk if arms and all(arm in descendants(skeleton, {j}) for arm in arms)] or trunk
    if holding:
        found["spine"] = holding[0]
    if len(holding) > 1:
        found["chest"] = holding[-1]
    for name, part in (("neck", Part.NECK), ("head", Part.HEAD)):
        named = [j for j, r in enumerate(roles) if r == Role(Side.MIDDLE, part)]
        if named:
            found[name] = named[0]
    return found


def _match_limb_by_words(roles: list[Role], side: Side) -> dict[str, int]:
    def named(part: Part) -> list[int]:
        return [joint for joint, role in enumerate(roles) if role == Role(side, part)]

    upper, lower = named(Part.UPPER_LEG), named(Part.LOWER_LEG)
    if not upper and len(lower) > 1:
        upper, lower = lower[:1], lower[1:]
    if not lower and len(upper) > 1:
        upper, lower = upper[:1], upper[1:]
    foot, toes = named(Part.FOOT), named(Part.TOES)
    toes = toes or foot[1:]  # an ankle and a foot
    shoulder, arm, elbow = named(Part.SHOULDER), named(Part.UPPER_ARM), named(Part.LOWER_ARM)
    if not elbow and len(arm) > 1:
        arm, elbow = arm[:1], arm[1:]
    if not arm and shoulder:
        shoulder, arm = shoulder[:-1], shoulder[-1:]  # a shoulder, an elbow and a wrist
    names = ("UpperLeg", "LowerLeg", "Foot", "Toes", "Shoulder", "UpperArm", "LowerArm", "Hand")
    joints = (upper, lower, foot, toes, shoulder, arm, elbow, named(Part.HAND))
    return {side.value + name: found[0] for name, found in zip(names, joints, strict=True) if found}


def _assign_sides(
    by_tree: Mapping[str, int], roles: tuple[Role, ...], skeleton: Skeleton, motion: Motion | None
) -> Mapping[str, int]:
    """Put limbs found by the tree alone on the side that their joints' names or else their positions show.

    Without names the legs' sides are arbitrary (see `correct_sides`) and the arms are on theirs.
    """
    if not by_tree:
        return by_tree
    unmatched = (None,) * CANONICAL.num_joints
    poses = RigPoses.zero(skeleton, unmatched) if motion is None else RigPoses.of(motion, unmatched)
    left = None
    for limb in (("UpperLeg", "LowerLeg", "Foot", "Toes"), ("UpperArm", "LowerArm", "Hand", "Shoulder")):
        votes = 0
        for side, other in (("left", "right"), ("right", "left")):
            sides = [roles[by_tree[side + part]].side.value for part in limb if side + part in by_tree]
            votes += sides.count(side) - sides.count(other)
        across = poses.positions[:, by_tree["left" + limb[0]]] - poses.positions[:, by_tree["right" + limb[0]]]
        if votes < 0 or (votes == 0 and left is not None and float((across * left).sum()) < 0):
            names = {side + part for side in ("left", "right") for part in limb}
            by_tree = {mirror_name(name) if name in names else name: joint for name, joint in by_tree.items()}
            across = -across
        left = across
    return by_tree
