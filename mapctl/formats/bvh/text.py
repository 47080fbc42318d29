"""The text of a BVH file to plain arrays and back, in the file's own unit and degrees.

Tolerant on syntax: case of keywords, tabs, CRLF, byte-order marks, braces anywhere, names with spaces or
colons, missing End Sites, `Frames :`. Strict on data: every value must be there and be a finite number, or NaN where
what is lost is asked for. As many frames are read as whole rows follow, with a warning where `Frames:` says another
number or the last row is cut off.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats import missing
from mapctl.formats.bvh.hierarchy import Hierarchy, Scanner, read_hierarchy
from mapctl.formats.frame_rate import LONGEST_FRAME, SHORTEST_FRAME
from mapctl.formats.text import (
    LARGEST_VALUE,
    NUMBER,
    check_extent,
    decode,
    finite_number,
    read_bytes,
    shorten,
    warn_once,
)

_FRAMES = re.compile(r"\s*+frames[ \t]*+:?[ \t]*+([^\s:]+)", re.IGNORECASE)
_CUT_NUMBER = re.compile(r"[-+.0-9eEnaN]+")
_DATUM = re.compile(r"\S+", re.ASCII)  # a no-break space parts no numbers
_FRAME_TIME = re.compile(r"\s*+frame[ \t]*+time[ \t]*+:?[ \t]*+([^\s:]+)", re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class BvhText:
    """Content of a BVH file."""

    hierarchy: Hierarchy
    """Joints, channels and offsets."""
    frame_time: str
    """Seconds of one frame, as printed."""
    values: np.ndarray
    """(frames, channels), file unit and degrees."""
    encoding: str
    """How names are encoded: utf-8 or latin-1."""


def read(path: str | PathLike[str], *, lossy: bool = False) -> BvhText:
    """Read a BVH file. FileFormatError names the line and what was expected there.

    A `lossy` one may hold NaN among its values, but not only NaN.
    """
    text, encoding = decode(path, read_bytes(path), "BVH text")
    scanner = Scanner(path, text)
    hierarchy = read_hierarchy(scanner)
    frames, frames_line = _parse_frame_count(scanner), scanner.line
    frame_time = _parse_frame_time(scanner)
    labels = hierarchy.labels()
    values = _parse_values(scanner, labels, frames=frames, frames_line=frames_line, lossy=lossy)
    missing.check_any_known(path, np.isnan(values))
    check_extent(path, len(values), len(hierarchy.names))
    return BvhText(hierarchy, frame_time, values, encoding)


def _parse_frame_count(scanner: Scanner) -> int:
    word = scanner.match(_FRAMES, "'Frames: COUNT'")
    if not re.fullmatch(r"[+]?[0-9]{1,12}", word):
        scanner.fail(f"expected a positive number of frames, got {shorten(word)}")
    return int(word)


def _parse_frame_time(scanner: Scanner) -> str:
    word = scanner.match(_FRAME_TIME, "'Frame Time: SECONDS'")
    seconds = finite_number(word)
    if seconds is None or len(word) > 60 or not SHORTEST_FRAME <= seconds <= LONGEST_FRAME:
        allowed = f"between {SHORTEST_FRAME:g} and {LONGEST_FRAME:g} s"
        scanner.fail(f"expected a frame time {allowed}, got {shorten(word)}")
    return word


def _parse_values(scanner: Scanner, labels: Sequence[str], *, frames: int, frames_line: int, lossy: bool) -> np.ndarray:
    """Parse the motion block as (frames, channels), in one go; only a fault is looked for by row."""
    width = len(labels)
    if width == 0:
        scanner.fail("no joint has any CHANNELS, expected at least one")
    counts, said, note = [len(row.split()) for _, row in _iterate_rows(scanner)], f"'Frames: {frames}'", ""
    if counts and sum(counts) != frames * width:
        if _drop_cut_row(scanner, width, may_end_in_number=len(counts) < frames or frames == 0):
            counts.pop()
            note = ", before one that is cut off"
        frames, note = len(counts), f"{scanner.path}: {said} but {len(counts)} whole rows follow{note}; it reads those"
    if not counts:
        raise FileFormatError(scanner.path, f"{said} but no whole row follows", frames_line)
    text = scanner.text[scanner.stop :]
    try:
        values = np.fromstring(missing.normalise_nan(text) if lossy else text, sep=" ")
    except ValueError:
        values = np.empty(0)
    # NaN compares as not small. `1.5.2` was parsed as two values, so words are counted too.
    sound = values.size == sum(counts) == frames * width
    if not sound or not ((np.abs(values) < LARGEST_VALUE) | (lossy & np.isnan(values))).all():
        fault = _find_fault(scanner, labels, may_wrap=sum(counts) == frames * width, lossy=lossy)
        raise fault or FileFormatError(scanner.path, f"{said} but {len(counts)} rows follow", frames_line)
    if note:
        warn_once(note)
    return values.reshape(frames, width)


def _drop_cut_row(scanner: Scanner, width: int, *, may_end_in_number: bool) -> bool:
    """Remove the last row from the text where its writer ended within it; return whether it did."""
    text = scanner.text.rstrip()
    start = text.rfind("\n") + 1
    words = text[start:].split()
    lost = len(words) < width or (may_end_in_number and not scanner.text.endswith("\n"))
    if not lost or len(words) > width or not _CUT_NUMBER.fullmatch(words[-1]):
        return False
    if any(finite_number(word) is None and not missing.is_nan(word) for word in words[:-1]):
        return False
    scanner.text = text[:start]
    return True


def _iterate_rows(scanner: Scanner) -> Iterator[tuple[int, str]]:
    """Yield line number and text of every row that is not blank."""
    text, start, line = scanner.text, scanner.stop, scanner.line_of(scanner.stop)
    while start < len(text):
        stop = text.find("\n", start)
        stop = len(text) if stop < 0 else stop
        row = text[start:stop]
        if row and not row.isspace():
            yield line, row
        start, line = stop + 1, line + 1


def _find_fault(scanner: Scanner, labels: Sequence[str], *, may_wrap: bool, lossy: bool) -> FileFormatError | None:
    """Find the first value that is no number, or the first row of a wrong length (where rows may not be wrapped)."""
    read = 0
    for line, row in _iterate_rows(scanner):
        words = _DATUM.findall(row)
        for place, word in enumerate(words, read):
            if finite_number(word) is None and not (lossy and missing.is_nan(word)):
                frame, column = divmod(place, len(labels))
                where = f"frame {frame}, column {column + 1} ({labels[column]})"
                got = f"{shorten(word)}{missing.missing_hint(word)}"
                return FileFormatError(scanner.path, f"{where}: expected {NUMBER}, got {got}", line)
        if len(words) != len(labels) and not may_wrap:
            count = f"frame {read // len(labels)} has {len(words)} values, expected {len(labels)}"
            return FileFormatError(scanner.path, count, line)
        read += len(words)
    return None


def compose(hierarchy: Hierarchy, frame_time: str, values: np.ndarray, *, decimals: int) -> str:
    """Compose the text of a BVH file; `values` (frames, channels) get `decimals` digits after the point."""
    row = " ".join([f"%.{decimals}f"] * values.shape[1])
    # Adding zero turns -0.0 into 0.0.
    rows = [row % tuple(frame) for frame in (np.round(values, decimals) + 0.0).tolist()]
    head = ["HIERARCHY", *_hierarchy_lines(hierarchy, decimals)]
    return "\n".join([*head, "MOTION", f"Frames: {len(rows)}", f"Frame Time: {frame_time}", *rows, ""])


def _hierarchy_lines(hierarchy: Hierarchy, decimals: int) -> Iterator[str]:
    open_joints: list[int] = []
    for joint, parent in enumerate(hierarchy.parents):
        while open_joints and open_joints[-1] != parent:
            open_joints.pop()
            yield "\t" * len(open_joints) + "}"
        tab, channels = "\t" * len(open_joints), hierarchy.channels[joint]
        yield f"{tab}{'JOINT' if open_joints else 'ROOT'} {hierarchy.names[joint]}"
        yield f"{tab}{{"
        yield f"{tab}\t{_offset_line(hierarchy.offsets[joint], decimals)}"
        yield f"{tab}\t{' '.join(['CHANNELS', str(len(channels)), *channels])}"
        if joint in hierarchy.end_offsets:
            end = _offset_line(hierarchy.end_offsets[joint], decimals)
            yield from (f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\t{end}", f"{tab}\t}}")
        open_joints.append(joint)
    for depth in reversed(range(len(open_joints))):
        yield "\t" * depth + "}"


def _offset_line(offset: Sequence[float], decimals: int) -> str:
    return " ".join(["OFFSET", *(f"{round(value, decimals) + 0.0:.{decimals}f}" for value in offset)])
