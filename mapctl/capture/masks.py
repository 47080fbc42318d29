"""Masks: what of a recording its user says not to believe. CSV with the columns joint, start, stop."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from mapctl.errors import FileFormatError, RequestError
from mapctl.motion import Motion

_COLUMNS = ("joint", "start", "stop")
ALL, ROOT = "*", "root position"
"""Names that stand for everything, and for the place of the root."""


@dataclass(frozen=True)
class Mask:
    """Frames in which a joint is not to be believed."""

    joint: str
    """Of the recording's own rig; `*` for all of it, `root position` for where it is."""
    start: int
    """First frame, from 0."""
    stop: int
    """One past the last."""


def load_masks(path: str | PathLike[str]) -> tuple[Mask, ...]:
    """Read a CSV; FileFormatError says which line is wrong."""
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
            names = rows[0].keys() if rows else _COLUMNS
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(path, f"no readable CSV ({error})") from error
    if missing := [name for name in _COLUMNS if name not in names]:
        raise FileFormatError(path, f"needs the columns {', '.join(_COLUMNS)}; {', '.join(missing)} missing")
    return tuple(_mask(path, line, row) for line, row in enumerate(rows, start=2))


def _mask(path: str | PathLike[str], line: int, row: dict) -> Mask:
    try:
        mask = Mask(row["joint"].strip(), int(row["start"]), int(row["stop"]))
    except (ValueError, TypeError, AttributeError):
        raise FileFormatError(path, f"line {line}: start and stop are whole frames, got {list(row.values())}") from None
    if not 0 <= mask.start < mask.stop:
        raise FileFormatError(path, f"line {line}: needs 0 <= start < stop, got {mask.start} and {mask.stop}")
    return mask


def masked(motion: Motion, masks: Sequence[Mask]) -> tuple[Tensor, Tensor]:
    """Which joints (frames, joints) and root places (frames,) are masked.

    RequestError for joints that the rig has not (with the nearest that it has), frames beyond the end, and joints of
    which nothing would be left.
    """
    names = motion.skeleton.names
    joints = torch.zeros(motion.num_frames, len(names), dtype=torch.bool)
    root = torch.zeros(motion.num_frames, dtype=torch.bool)
    for mask in masks:
        if mask.stop > motion.num_frames:
            raise RequestError(f"the mask of {mask.joint} ends at {mask.stop}, the recording at {motion.num_frames}")
        if mask.joint in (ALL, ROOT):
            root[mask.start : mask.stop] = True
        if mask.joint == ALL:
            joints[mask.start : mask.stop] = True
        elif mask.joint != ROOT:
            joints[mask.start : mask.stop, _index(names, mask.joint)] = True
    if root.all() or joints.all(dim=0).any():
        gone = "root position" if root.all() else names[int(joints.all(dim=0).nonzero()[0])]
        raise RequestError(f"the masks leave nothing of {gone}")
    return joints, root


def part_of(masks: Sequence[Mask], start: int, stop: int) -> tuple[Mask, ...]:
    """The masks of frames start to stop, counted from there."""
    clipped = [Mask(m.joint, max(m.start, start) - start, min(m.stop, stop) - start) for m in masks]
    return tuple(mask for mask in clipped if mask.start < mask.stop)


def _index(names: Sequence[str], wanted: str) -> int:
    if wanted in names:
        return names.index(wanted)
    near = get_close_matches(wanted, names, n=1, cutoff=0)
    raise RequestError(f"no joint {wanted!r} to mask; the nearest is {near[0] if near else 'none'}")
