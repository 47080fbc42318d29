"""Frames on the command line: whole numbers from 0, or seconds as in 1.5s; ranges A:B, the stop exclusive."""

import re
from collections.abc import Sequence
from itertools import pairwise

from mapctl.errors import RequestError

_FRAME = re.compile(r"(\d{1,9})|(\d{1,9}(?:\.\d{0,9})?|\.\d{1,9})s")


def parse_frame(text: str, *, fps: float) -> int:
    """Parse `45` or `1.5s` as a frame of a motion of that rate; RequestError for anything else."""
    found = _FRAME.fullmatch(text.strip())
    if found is None:
        raise RequestError(f"a frame is a whole number from 0, or seconds as in 1.5s; got {text!r}")
    return int(found[1]) if found[1] is not None else round(float(found[2]) * fps)


def parse_range(text: str, *, fps: float, frames: int, what: str = "gap") -> tuple[int, int]:
    """Parse `60:120` or `2s:4s` as first frame and one past the last; RequestError unless they are in the motion."""
    start, colon, stop = text.partition(":")
    if not colon:
        raise RequestError(f"a {what} is A:B, frames or seconds as in 60:120 or 2s:4s; got {text!r}")
    first, last = parse_frame(start, fps=fps), parse_frame(stop, fps=fps)
    if not first < last <= frames:
        raise RequestError(f"the {what} {text} must begin before it ends, within the motion's frames 0:{frames}")
    return first, last


def parse_ranges(texts: Sequence[str], *, fps: float, frames: int, what: str = "gap") -> list[tuple[int, int]]:
    """Parse several ranges, sorted by time; RequestError for two that overlap."""
    ranges = sorted(parse_range(text, fps=fps, frames=frames, what=what) for text in texts)
    for (start, stop), (after, end) in pairwise(ranges):
        if after < stop:
            raise RequestError(f"the {what}s {start}:{stop} and {after}:{end} overlap; make them one")
    return ranges
