"""The HIERARCHY block of a BVH file: joints, channels, offsets. No recursion: depth costs nothing."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import count, pairwise
from os import PathLike
from typing import NoReturn

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.text import NUMBER, finite_number, shorten, warn_once

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
