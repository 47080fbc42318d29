"""The length unit of a motion file that does not say: found from the size of the body."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

UNITS_IN_METRES = (1.0, 0.01, 0.0254, 0.056444, 0.001)
"""Metre, centimetre, inch, the CMU ASF unit (inch / 0.45), millimetre; the first that fits counts."""
LEG_METRES = (0.5, 1.4)
"""Least and greatest length of people from hips to toes along the bones, metres."""
REACH_METRES = (0.8, 2.2)
"""Least and greatest length of people from the root to a leaf along the bones (hips to fingertips or toes), metres."""

_TOES, _FEET, _HIPS = ("toe",), ("foot", "ankle"), ("hips", "pelvis")


def metres_per_unit(
    names: Sequence[str],
    parents: Sequence[int],
    offsets: np.ndarray,
    *,
    end_offsets: Mapping[int, Sequence[float]],
    moving: Collection[int] = (),
) -> float:
    """Return how many metres one unit of `offsets` (joints, 3) is, for a skeleton of about human size.

    Bones are measured from hips to toes; where no leg is named, from the root to the farthest leaf. `moving` joints
    travel within their parent, so the way to them is no bone. A body of no length counts as centimetres.
    """
    lengths = np.linalg.norm(offsets, axis=1)
    lengths[[0, *moving]] = 0.0
    ends = {joint: float(np.linalg.norm(offset)) for joint, offset in end_offsets.items()}
    size, fits = hips_to_toes_length(names, parents, lengths, ends, moving), LEG_METRES
    if size == 0:
        size, fits = longest_chain_length(parents, lengths, ends), REACH_METRES
    if size == 0:
        return 0.01
    for unit in UNITS_IN_METRES:
        if fits[0] <= size * unit <= fits[1]:
            return unit
    middle = np.sqrt(fits[0] * fits[1])
    return min(UNITS_IN_METRES, key=lambda unit: abs(np.log(size * unit / middle)))


def hips_to_toes_length(
    names: Sequence[str],
    parents: Sequence[int],
    lengths: np.ndarray,
    ends: Mapping[int, float],
    moving: Collection[int] = (),
) -> float:
    """Return hips to toes along the bones, or to the foot's End Site if there are no toes; 0 if no foot is named."""
    plain = [_normalise_name(name) for name in names]
    joint = _first_named(_TOES, plain) or _first_named(_FEET, plain)
    if joint is None:
        return 0.0
    length = 0.0 if _any_in(_TOES, plain[joint]) else ends.get(joint, 0.0)
    while joint > 0 and joint not in moving and plain[joint] != "hip" and not _any_in(_HIPS, plain[joint]):
        length, joint = length + float(lengths[joint]), parents[joint]
    return length


def longest_chain_length(parents: Sequence[int], lengths: np.ndarray, ends: Mapping[int, float]) -> float:
    """Return the length of the longest chain of bones from the root to a leaf or End Site, in the unit of `lengths`."""
    way = np.zeros(len(parents))
    for joint in range(1, len(parents)):
        way[joint] = way[parents[joint]] + lengths[joint]
    return float(max(way[joint] + ends.get(joint, 0.0) for joint in range(len(parents))))


def _normalise_name(name: str) -> str:
    """Normalise a name: `mixamorig:LeftToe_Base` is `lefttoebase`."""
    return "".join(filter(str.isalnum, name.rpartition(":")[2])).lower()


def _first_named(words: Sequence[str], names: Sequence[str]) -> int | None:
    return next((joint for joint, name in enumerate(names) if _any_in(words, name)), None)


def _any_in(words: Sequence[str], name: str) -> bool:
    return any(word in name for word in words)
