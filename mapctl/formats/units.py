"""The length unit of a motion file, declared or found from the size of the body, and the exact frame rate behind a
printed frame time: 0.0333333 means 30 fps, 0.041708 means 24000/1001.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from os import PathLike

import numpy as np

from mapctl.errors import RequestError
from mapctl.formats.text import warn_once

UNITS = {
    "metres": 1.0,
    "decimetres": 0.1,
    "CMU ASF units": 0.056444,
    "inches": 0.0254,
    "centimetres": 0.01,
    "millimetres": 0.001,
}
"""Units of files that declare none, metres; the ASF unit is inch / 0.45."""
ADULT_LEG = 1.0
"""Length of an adult from hips to toes along the bones, metres."""
ADULT_REACH = 1.2
"""Length of an adult from the root to the farthest leaf (head top, fingertips or toes) along the bones, metres."""
MIN_RATIO = 1.25
"""Ratio of the distances of two units' bodies from an adult, below which both are likely."""

_TOES, _FEET, _HIPS = ("toe",), ("foot", "ankle"), ("hips", "pelvis")


@dataclass(frozen=True, eq=False)
class FileUnit:
    """The unit of lengths in a file, which `Motion.source` keeps."""

    metres_per_unit: float
    """Length of the unit, metres."""
    unit_doubt: str = field(default="", kw_only=True)
    """Why a unit found by the size of the body may be wrong, a sentence without a full stop; empty where it is sure."""


def guess_unit(
    names: Sequence[str],
    parents: Sequence[int],
    offsets: np.ndarray,
    *,
    end_offsets: Mapping[int, Sequence[float]],
    moving: Collection[int] = (),
) -> FileUnit:
    """Return the unit of `offsets` (joints, 3) in which the body is nearest to an adult, by the ratio of lengths.

    Bones are measured from hips to toes; where no leg is named, from the root to the farthest leaf. `moving` joints
    travel within their parent, so their offset is no bone. A body of no length counts as centimetres.
    """
    lengths = np.linalg.norm(offsets, axis=1)
    lengths[[0, *moving]] = 0.0
    ends = {joint: float(np.linalg.norm(offset)) for joint, offset in end_offsets.items()}
    size, adult, part = _hips_to_toes_length(names, parents, lengths, ends, moving), ADULT_LEG, "legs are"
    if size == 0:
        size, adult, part = longest_chain_length(parents, lengths, ends), ADULT_REACH, "the longest chain of bones is"
    if size == 0:
        return FileUnit(0.01)
    distance = {unit: abs(np.log(size * metres / adult)) for unit, metres in UNITS.items()}
    best, second, *_ = sorted(UNITS, key=distance.__getitem__)
    doubt = ""
    if distance[second] - distance[best] < np.log(MIN_RATIO):
        lengths_text = " or ".join(f"{size * UNITS[unit]:.2f} m if its unit is {unit}" for unit in (best, second))
        doubt = f"the unit of the file is a guess: {part} {lengths_text}"
    return FileUnit(UNITS[best], unit_doubt=doubt)


def _hips_to_toes_length(
    names: Sequence[str],
    parents: Sequence[int],
    lengths: np.ndarray,
    ends: Mapping[int, float],
    moving: Collection[int],
) -> float:
    """Return hips to toes along the bones, or to the foot's End Site if there are no toes; 0 if no foot is named."""
    plain = ["".join(filter(str.isalnum, name.rpartition(":")[2])).lower() for name in names]  # lefttoebase

    def named(joint: int, words: Sequence[str]) -> bool:
        return any(word in plain[joint] for word in words)

    joint = next((j for words in (_TOES, _FEET) for j in range(len(plain)) if named(j, words)), None)
    if joint is None:
        return 0.0
    length = 0.0 if named(joint, _TOES) else ends.get(joint, 0.0)
    while joint > 0 and joint not in moving and plain[joint] != "hip" and not named(joint, _HIPS):
        length, joint = length + float(lengths[joint]), parents[joint]
    return length


def longest_chain_length(parents: Sequence[int], lengths: np.ndarray, ends: Mapping[int, float]) -> float:
    """Return the length of the longest chain of bones from the root to a leaf or End Site, in the unit of `lengths`."""
    distance = np.zeros(len(parents))
    for joint in range(1, len(parents)):
        distance[joint] = distance[parents[joint]] + lengths[joint]
    return float(max(distance[joint] + ends.get(joint, 0.0) for joint in range(len(parents))))


SHORTEST_FRAME, LONGEST_FRAME = 1e-5, 100.0
"""Least and greatest frame time, seconds."""
SLOWEST, FASTEST = 0.01, 1e5
"""Least and greatest frame rate, frames per second."""

_RATES = (30, 60, 120, 24, 25, 50, 100, 15, 20, 40, 48, 72, 75, 90, 144, 150, 200, 240)
_COMMON = tuple(Fraction(rate) for rate in _RATES)
_TELEVISION = tuple(Fraction(rate * 1000, 1001) for rate in (24, 30, 48, 60, 120, 240))
_FLOAT32 = 1.2e-7  # Some exporters print a float32 with 17 digits, of which 7 mean something.


def frame_rate(frame_time: str) -> Fraction:
    """Return frames per second of a frame time as printed (seconds, a finite positive decimal number).

    A sensible rate whose frame time, rounded or cut, prints as this text; else the reciprocal as it is.
    """
    printed = Decimal(frame_time)
    seconds, exact = float(printed), 1 / Fraction(printed)
    # One digit is too little to second-guess, and a whole rate needs no help.
    if len(printed.normalize().as_tuple().digits) < 2 or exact.denominator == 1:
        return exact
    unit = 10.0 ** int(printed.as_tuple().exponent)
    low = seconds - max(unit / 2, seconds * _FLOAT32)
    high = seconds + max(unit, seconds * _FLOAT32)  # a cut number lies up to a whole unit above its print
    near = tuple(exact.limit_denominator(largest) for largest in (1, 4))
    for rate in (*_COMMON, *_TELEVISION, *near):
        if rate > 0 and low <= 1 / rate < high:
            return rate
    return exact


USUAL_FPS = Fraction(30)
"""Frames per second of a file that neither states nor shows them."""
_UNEVEN_SHARE = 0.02  # of a frame that a key may lie beside it


def choose_rate(path: str | PathLike[str], stated: float | None, requested: Fraction | float | None) -> float:
    """Return frames per second: those that a file states or, where it states none, the requested ones, else USUAL_FPS
    with a warning. RequestError where both are given."""
    if stated is not None and requested is not None:
        raise RequestError(f"{path}: has a frame rate of its own, {stated:g}; leave the requested one out")
    if stated is None and requested is None:
        warn_once(f"{path}: has no frame rate: {USUAL_FPS} frames a second are assumed; see --fps-in of mapctl convert")
    return float(next((rate for rate in (stated, requested) if rate is not None), USUAL_FPS))


def sample_times(keys: np.ndarray) -> tuple[Fraction, np.ndarray]:
    """Return frames per second and the times, seconds, at which to read an animation with keys at these times.

    Keys that lie on the frames of one rate (not on all of them need one lie) give that rate; others are read at 30
    frames a second, the last key at or before the last frame.
    """
    keys = np.unique(np.asarray(keys, np.float64))
    if len(keys) < 2:
        return USUAL_FPS, keys[:1] if len(keys) else np.zeros(1)
    fps = _find_rate(keys - keys[0])
    count = int(np.floor((keys[-1] - keys[0]) * float(fps) + _UNEVEN_SHARE)) + 1
    return fps, keys[0] + np.arange(count) / float(fps)


def _find_rate(keys: np.ndarray) -> Fraction:
    """Return the rate of which every key, from 0 on, is a frame; 30 where there is none."""
    apart = np.diff(keys)
    step = float(np.median(apart[apart > 0.25 * np.median(apart)]))
    for seconds in (step, *(step / part for part in (2, 3, 4, 5)), 1 / 30, 1 / 24, 1 / 25, 1 / 60, 1 / 120):
        if not 1 / FASTEST < seconds < 100:
            continue
        seconds = keys[-1] / max(1, round(keys[-1] / seconds))  # keys are rounded one by one, their whole span hardly
        fps = frame_rate(f"{seconds:.7f}") if seconds > 1e-4 else Fraction(1 / seconds)
        frames = keys * float(fps)
        if np.abs(frames - np.rint(frames)).max() < _UNEVEN_SHARE:
            return fps
    return USUAL_FPS


def frame_rate_of(rate: float) -> Fraction:
    """Return the exact frame rate behind a rounded floating-point one: 29.97 is 30000/1001."""
    near = frame_rate(f"{1.0 / rate:.6f}") if 0.01 < rate < 1e4 else Fraction(rate)
    return near if abs(float(near) / rate - 1.0) < 1e-5 else Fraction(rate).limit_denominator(10_000)
