"""Matching joints by the names of the listed rigs: which rig explains most of a skeleton, and which one as much."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from mapctl.joint_names import normalise_name
from mapctl.retarget.rigs import Rig, known_rigs
from mapctl.skeleton import Skeleton

_ARMS_ON_CHEST = 0.5  # joints that a chest from which the shoulders hang is worth
_NEAR = 0.05  # joints by which a rig may fit less well and still be as near
_MIN_PREFIXED = 5  # joints whose names begin alike, from which this is a prefix
_BEGINNING = re.compile(r"[^_:|.\- ]+[_:|.\- ](?=.)")  # of a name, up to its first separator


@dataclass(frozen=True)
class Listed:
    """The listed rig that fits a skeleton best."""

    rig: Rig
    """The rig."""
    joints: Mapping[str, int]
    """The skeleton's joint by canonical name."""
    rivals: tuple[tuple[str, str], ...] = ()
    """Other listed rigs that fit as well and take another joint for some canonical one: each with that canonical
    name."""


def find_listed_rig(skeleton: Skeleton, required: Collection[str]) -> Listed | None:
    """Find the listed rig that explains most of the skeleton, if one has all joints that are required."""
    fits: list[tuple[float, Rig, dict[str, int]]] = []
    plain = {normalise_name(name) for name in skeleton.names}
    for rig in known_rigs():
        found = match_by_rig(rig, skeleton)
        complete = all(name in found for name in required)
        if not complete or (rig.name == "canonical" and not rig.fits(skeleton)):
            continue
        fits.append((_measure_fit(rig, found, skeleton, plain), rig, found))
    if not fits:
        return None
    best, rig, joints = max(fits, key=lambda fit: fit[0])
    near = [(other.name, found) for fit, other, found in fits if fit >= best - _NEAR]
    differing = [(name, [c for c in joints if found.get(c, joints[c]) != joints[c]]) for name, found in near]
    return Listed(rig, joints, tuple((name, canonical[0]) for name, canonical in differing if canonical))


def match_by_rig(rig: Rig, skeleton: Skeleton) -> dict[str, int]:
    """Match joints by a rig's names, in the version that fits best; spelling and prefixes count where they must."""
    exact = {name: joint for joint, name in enumerate(skeleton.names)}
    plain = _index_plain_names(skeleton.names)
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


def without_shared_prefix(names: Sequence[str]) -> list[str]:
    """Return the names without what most of them begin with, up to a separator: `Skeleton0_Hips` is `Hips`."""
    beginnings = [match[0] for match in map(_BEGINNING.match, names) if match]
    (most, count), *_ = Counter(beginnings).most_common(1) or [("", 0)]
    if count <= max(_MIN_PREFIXED, len(names) / 2):
        return list(names)
    return without_shared_prefix([name.removeprefix(most) for name in names])


@lru_cache(maxsize=8)
def _index_plain_names(names: tuple[str, ...]) -> dict[str, int]:
    """Return the joint by normalised name, with and without a prefix that joints share; whole names come first."""
    found: dict[str, int] = {}
    for spelled in (names, without_shared_prefix(names)):
        for joint, name in enumerate(spelled):
            found.setdefault(normalise_name(name), joint)
    return found


def _measure_fit(rig: Rig, found: Mapping[str, int], skeleton: Skeleton, plain: set[str]) -> float:
    """Measure how well a rig explains a skeleton: the joints it names, and below one joint each what distinguishes
    relatives."""
    extra = {normalise_name(name) for name in (*rig.also, *rig.trunk)}
    explained = len(found) + len(extra & plain - {normalise_name(skeleton.names[j]) for j in found.values()})
    lacking = len(rig.joints) - len(found) + len(extra - plain)
    # Fingers and props beyond what a preset lists do not count against it; what it lists and the rig lacks does.
    spelled = sum(skeleton.names[joint] in (rig.joints[c], *rig.aliases.get(c, ())) for c, joint in found.items())
    carried = _ARMS_ON_CHEST * _arms_hang_from_chest(found, skeleton)
    return len(found) + explained / (explained + lacking) + spelled / len(found) + carried


def _arms_hang_from_chest(found: Mapping[str, int], skeleton: Skeleton) -> bool:
    """Return whether the chest is the joint from which the shoulders, or else the upper arms, hang."""
    arms = [found.get(side + "Shoulder", found.get(side + "UpperArm")) for side in ("left", "right")]
    return all(arm is not None and skeleton.parents[arm] == found.get("chest") for arm in arms)
