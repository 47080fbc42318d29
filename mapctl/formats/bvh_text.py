"""The text of a BVH file to plain arrays and back, in the file's own unit and degrees.

Tolerant on syntax: case of keywords, tabs, CRLF, byte-order marks, braces anywhere, names with spaces or
colons, missing End Sites, `Frames :`. Strict on data: every value must be there and be a finite number, or NaN where
what is lost is asked for. As many frames are read as whole rows follow, with a warning where `Frames:` says another
number or the last row is cut off.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, pairwise
from os import PathLike
from typing import NoReturn

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats import missing
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
from mapctl.formats.units import LONGEST_FRAME, SHORTEST_FRAME

MAX_JOINTS = 1000
"""Most joints that are read; a body with fingers, face and props has about 200."""
MAX_CHANNELS = 6
"""Most channels of one joint: three positions and three rotations."""

AXES = {"X": 0, "Y": 1, "Z": 2}
"""Index of an axis in a vector."""

_WORD = re.compile(r"\s*+([{}]|[^\s{}]++)")
_NAME = re.compile(r"\s*+([^\n{}]*+)")
_JOINT_LINE = re.compile(r"^[ \t]*(?:ROOT|JOINT)[ \t]+([^\n{}]+)", re.IGNORECASE | re.MULTILINE)
_CHANNEL = re.compile(r"([XYZ])(position|rotation)", re.IGNORECASE)

Offset = tuple[float, float, float]
_ORIGIN: Offset = (0.0, 0.0, 0.0)


class Scanner:
    """Words of a text, and the line each stands on. `start` and `stop` enclose the last word taken."""

    def __init__(self, path: str | PathLike[str], text: str):
        self.path, self.text, self.start, self.stop = path, text, 0, 0

    def word(self) -> str:
        """Read the next word or brace; empty at the end of the text."""
        return self._take(_WORD)

    def name(self) -> str:
        """Read a joint's name: the rest of the line up to a brace, so that it may hold spaces."""
        name = self._take(_NAME).rstrip()
        return name or self.fail(f"expected a joint's name, got {self.shown(self.word())}")

    def number(self, meaning: str) -> float:
        """Read the next word as a finite number."""
        word = self.word()
        value = finite_number(word)
        return self.fail(f"expected {meaning} as {NUMBER}, got {self.shown(word)}") if value is None else value

    def match(self, pattern: re.Pattern[str], meaning: str) -> str:
        """Take the first group of `pattern`, which must come next."""
        return self._take(pattern) or self.fail(f"expected {meaning}, got {self.shown(self.word())}")

    def expect(self, wanted: str) -> None:
        """Take one word that must be `wanted`."""
        word = self.word()
        if word.upper() != wanted:
            self.fail(f"expected {wanted!r}, got {self.shown(word)}")

    def fail(self, message: str) -> NoReturn:
        """Raise FileFormatError at the line of the last word."""
        raise FileFormatError(self.path, message, self.line)

    @property
    def line(self) -> int:
        """Line of the last word, from 1."""
        return self.line_of(self.start)

    def line_of(self, position: int) -> int:
        """Return the line of a position in the text, from 1."""
        return self.text.count("\n", 0, position) + 1

    @staticmethod
    def shown(word: str) -> str:
        """Quote a word for a message."""
        return shorten(word) if word else "the end of the file"

    def _take(self, pattern: re.Pattern[str]) -> str:
        found = pattern.match(self.text, self.stop)
        if found is None:
            self.start = self.stop
            return ""
        self.start, self.stop = found.span(1)
        return found.group(1)


@dataclass(frozen=True)
class Hierarchy:
    """Joints in file order; every parent precedes its children. Lengths are in the file's unit."""

    names: tuple[str, ...]
    """Joint names, unique: of joints that share one in the file, all but the first have a number behind it."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for the root."""
    offsets: tuple[Offset, ...]
    """OFFSET of each joint."""
    channels: tuple[tuple[str, ...], ...]
    """CHANNELS of each joint as `Xposition`, `Zrotation`; empty for a joint that never moves."""
    end_offsets: Mapping[int, Offset]
    """End Sites: joint to the site's OFFSET."""

    def labels(self) -> list[str]:
        """Return the meaning of each column of the motion block: `Hips Zrotation`."""
        joints = zip(self.names, self.channels, strict=True)
        return [f"{name} {channel}" for name, channels in joints for channel in channels]

    def position_columns(self) -> list[dict[int, int]]:
        """Return by joint the map from axis (0, 1, 2 for X, Y, Z) to column of the motion block."""
        joints = self._columns()
        return [{AXES[c[0]]: column for c, column in joint if c.endswith("position")} for joint in joints]

    def rotation_groups(self) -> list[tuple[tuple[int, ...], list[int], np.ndarray]]:
        """Group joints by Euler order, to be converted together: axes, joints, and columns (joints, axes)."""
        groups: dict[tuple[int, ...], dict[int, list[int]]] = {}
        for joint, channels in enumerate(self._columns()):
            turns = [(AXES[c[0]], column) for c, column in channels if c.endswith("rotation")]
            axes = tuple(axis for axis, _ in turns)
            groups.setdefault(axes, {})[joint] = [column for _, column in turns]
        return [(axes, list(g), np.array(list(g.values()), dtype=int)) for axes, g in groups.items()]

    def _columns(self) -> list[list[tuple[str, int]]]:
        column = count()
        return [[(channel, next(column)) for channel in channels] for channels in self.channels]


def read_hierarchy(scanner: Scanner) -> Hierarchy:
    """Read from HIERARCHY to the word MOTION, which is taken too."""
    scanner.expect("HIERARCHY")
    reader = _Reader(scanner)
    while (word := scanner.word()).upper() != "MOTION":
        reader.take(word)
    return reader.finish()


@dataclass
class _Node:
    """A joint, or an End Site (whose parent is its joint), as far as it has been read."""

    name: str
    parent: int
    line: int
    is_end: bool = False
    offset: Offset | None = None
    channels: tuple[str, ...] | None = None

    def __str__(self) -> str:
        return f"the End Site of line {self.line}" if self.is_end else f"joint {shorten(self.name)}"


class _Reader:
    def __init__(self, scanner: Scanner):
        self.scanner = scanner
        self.joints: dict[str, int] = {}
        self.nodes: list[_Node] = []
        self.ends: dict[int, _Node] = {}
        self.open: list[_Node] = []
        self.renamed: list[str] = []
        self.handlers: dict[str, Callable[[], None]] = {
            "ROOT": self._root,
            "JOINT": self._joint,
            "END": self._end,
            "OFFSET": self._offset,
            "CHANNELS": self._channels,
            "}": self._close,
        }

    def take(self, word: str) -> None:
        handler = self.handlers.get(word.upper())
        if handler is None:
            allowed = "OFFSET, CHANNELS, JOINT, End Site or '}'" if self.open else "ROOT or MOTION"
            self.scanner.fail(f"expected {allowed}, got {self.scanner.shown(word)}")
        handler()

    def finish(self) -> Hierarchy:
        if self.open:
            self.scanner.fail(f"expected '}}' before MOTION: {self.open[-1]} is still open")
        if not self.nodes:
            self.scanner.fail("expected ROOT before MOTION")
        if self.renamed:
            more = f" and {len(self.renamed) - 3} more" if len(self.renamed) > 3 else ""
            warn_once(f"{self.scanner.path}: names must be unique, so it reads {', '.join(self.renamed[:3])}{more}")
        return Hierarchy(
            names=tuple(self.joints),
            parents=tuple(node.parent for node in self.nodes),
            offsets=tuple(node.offset or _ORIGIN for node in self.nodes),
            channels=tuple(node.channels or () for node in self.nodes),
            end_offsets={joint: node.offset or _ORIGIN for joint, node in self.ends.items()},
        )

    def _root(self) -> None:
        if self.nodes:
            self.scanner.fail("a second ROOT, allowed is one")
        self._open_joint(parent=-1)

    def _joint(self) -> None:
        node = self._current("JOINT")
        if node.is_end:
            self.scanner.fail("a JOINT within an End Site, expected OFFSET or '}'")
        self._open_joint(parent=self.joints[node.name])

    def _open_joint(self, *, parent: int) -> None:
        name = self.scanner.name()
        if len(self.joints) == MAX_JOINTS:
            self.scanner.fail(f"more than {MAX_JOINTS} joints, which is the most allowed")
        if name in self.joints:
            name = self._unique_name(name)
        self.joints[name] = len(self.joints)
        self.nodes.append(_Node(name, parent, self.scanner.line))
        self._open_brace(self.nodes[-1])

    def _unique_name(self, name: str) -> str:
        """Make a name for a joint whose own is taken: `Bip01_2` for the second Bip01, one that no joint of the file
        has."""
        taken = {line.strip() for line in _JOINT_LINE.findall(self.scanner.text)} | set(self.joints)
        own = next(own for number in count(2) if (own := f"{name}_{number}") not in taken)
        self.renamed.append(f"the joint {shorten(name)} of line {self.scanner.line} as {own!r}")
        return own

    def _end(self) -> None:
        node = self._current("End Site")
        if node.is_end or self.joints[node.name] in self.ends:
            self.scanner.fail(f"a second End Site in {node}")
        end = _Node(self.scanner.name(), self.joints[node.name], self.scanner.line, is_end=True)
        self.ends[end.parent] = end
        self._open_brace(end)

    def _open_brace(self, node: _Node) -> None:
        self.scanner.expect("{")
        self.open.append(node)

    def _close(self) -> None:
        node = self._current("'}'")
        if node.offset is None:
            self.scanner.fail(f"{node} has no OFFSET")
        self.open.pop()

    def _offset(self) -> None:
        node = self._current("OFFSET")
        if node.offset is not None:
            self.scanner.fail(f"a second OFFSET in {node}")
        x, y, z = (self.scanner.number(f"the {axis} of OFFSET") for axis in "XYZ")
        node.offset = (x, y, z)

    def _channels(self) -> None:
        node = self._current("CHANNELS")
        if node.channels is not None:
            self.scanner.fail(f"a second CHANNELS in {node}")
        most = 0 if node.is_end else MAX_CHANNELS
        number = self.scanner.word()
        if number not in map(str, range(most + 1)):
            self.scanner.fail(f"expected 0 to {most} CHANNELS in {node}, got {self.scanner.shown(number)}")
        node.channels = tuple(self._channel() for _ in range(int(number)))
        self._check(node.channels)

    def _channel(self) -> str:
        word = self.scanner.word()
        found = _CHANNEL.fullmatch(word)
        if found is None:
            self.scanner.fail(f"expected a channel as Xposition or Zrotation, got {self.scanner.shown(word)}")
        return found.group(1).upper() + found.group(2).lower()

    def _check(self, channels: tuple[str, ...]) -> None:
        """Check a joint's channels: ZXZ is an Euler order, ZZX is none; a position is given once."""
        positions = [c for c in channels if c.endswith("position")]
        rotations = [c for c in channels if c.endswith("rotation")]
        twice = any(a == b for a, b in pairwise(rotations))
        if twice or len(rotations) > 3 or len(set(positions)) < len(positions):
            self.scanner.fail(f"expected up to three positions and an Euler order, got {' '.join(channels)}")

    def _current(self, word: str) -> _Node:
        """Return the open node that `word` belongs to."""
        if not self.open:
            self.scanner.fail(f"{word} outside of a joint, expected ROOT or MOTION")
        return self.open[-1]


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
