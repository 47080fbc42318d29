"""BVH files to Motion and back, on the file's own skeleton and in its own channel layout.

A position channel replaces its joint's OFFSET when read. Lengths are scaled to metres by the size of the body (see
`units`), and scaled back when written. Frames of a joint that are as they were read get the numbers they had.

Reading is tolerant of syntax: case of keywords, tabs, CRLF, byte-order marks, braces anywhere, names with spaces or
colons, missing End Sites, `Frames :`. It is strict on data: every value must be there and be a finite number, or NaN
where missing values are allowed. As many frames are read as whole rows follow, with a warning where `Frames:` states
another number or the last row is cut off.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import count, pairwise
from os import PathLike
from typing import NoReturn

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import euler, missing
from mapctl.formats.atomic import write_bytes
from mapctl.formats.missing import MissingValues
from mapctl.formats.parts import NodeTree, make_unique
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
from mapctl.formats.units import LONGEST_FRAME, SHORTEST_FRAME, FileUnit, frame_rate, guess_unit, longest_chain_length
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

MAX_JOINTS = 1000
"""Most joints that are read; a body with fingers, face and props has about 200."""
MAX_CHANNELS = 6
"""Most channels of one joint: three positions and three rotations."""

AXES = {"X": 0, "Y": 1, "Z": 2}

_WORD = re.compile(r"\s*+([{}]|[^\s{}]++)")
_NAME = re.compile(r"\s*+([^\n{}]*+)")
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
        return self.text.count("\n", 0, self.start) + 1

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

    def rotation_columns(self) -> list[tuple[tuple[int, ...], list[int]]]:
        """Return by joint its Euler order, as axes, and the columns of its angles."""
        turns = [[(AXES[c[0]], column) for c, column in joint if c.endswith("rotation")] for joint in self._columns()]
        return [(tuple(axis for axis, _ in joint), [column for _, column in joint]) for joint in turns]

    def rotation_groups(self) -> list[tuple[tuple[int, ...], list[int], np.ndarray]]:
        """Group joints by Euler order, to be converted together: axes, joints, and columns (joints, axes)."""
        groups: dict[tuple[int, ...], dict[int, list[int]]] = {}
        for joint, (axes, columns) in enumerate(self.rotation_columns()):
            groups.setdefault(axes, {})[joint] = columns
        return [(axes, list(g), np.array(list(g.values()), dtype=int)) for axes, g in groups.items()]

    def _columns(self) -> list[list[tuple[str, int]]]:
        column = count()
        return [[(channel, next(column)) for channel in channels] for channels in self.channels]


@dataclass
class _Node:
    """A joint, or an End Site (of the joint `parent`), as far as it has been read."""

    name: str
    number: int
    parent: int
    line: int
    is_end: bool = False
    offset: Offset | None = None
    channels: tuple[str, ...] | None = None

    def __str__(self) -> str:
        return f"the End Site of line {self.line}" if self.is_end else f"joint {shorten(self.name)}"


def read_hierarchy(scanner: Scanner) -> Hierarchy:
    """Read from HIERARCHY to the word MOTION, which is taken too."""
    scanner.expect("HIERARCHY")
    joints, opened = list[_Node](), list[_Node]()
    ends: dict[int, _Node] = {}
    while (word := scanner.word().upper()) != "MOTION":
        if word not in ("ROOT", "JOINT", "END", "OFFSET", "CHANNELS", "}"):
            allowed = "OFFSET, CHANNELS, JOINT, End Site or '}'" if opened else "ROOT or MOTION"
            scanner.fail(f"expected {allowed}, got {scanner.shown(scanner.text[scanner.start : scanner.stop])}")
        if word == "ROOT":
            if joints:
                scanner.fail("a second ROOT, allowed is one")
            opened.append(_open_joint(scanner, joints, -1))
            continue
        if not opened:
            scanner.fail(f"{word} outside of a joint, expected ROOT or MOTION")
        node = opened[-1]
        if word == "JOINT":
            if node.is_end:
                scanner.fail("a JOINT within an End Site, expected OFFSET or '}'")
            opened.append(_open_joint(scanner, joints, node.number))
        elif word == "END":
            if node.is_end or node.number in ends:
                scanner.fail(f"a second End Site in {node}")
            ends[node.number] = _Node(scanner.name(), -1, node.number, scanner.line, is_end=True)
            scanner.expect("{")
            opened.append(ends[node.number])
        elif word == "OFFSET":
            if node.offset is not None:
                scanner.fail(f"a second OFFSET in {node}")
            x, y, z = (scanner.number(f"the {axis} of OFFSET") for axis in "XYZ")
            node.offset = (x, y, z)
        elif word == "CHANNELS":
            if node.channels is not None:
                scanner.fail(f"a second CHANNELS in {node}")
            node.channels = _read_channels(scanner, node)
        else:
            if node.offset is None:
                scanner.fail(f"{node} has no OFFSET")
            opened.pop()
    if opened or not joints:
        lacks = f"'}}' before MOTION: {opened[-1]} is still open" if opened else "ROOT before MOTION"
        scanner.fail(f"expected {lacks}")
    names = make_unique([node.name for node in joints])
    renamed = [
        f"the joint {shorten(node.name)} of line {node.line} as {name!r}"
        for node, name in zip(joints, names, strict=True)
        if name != node.name
    ]
    if renamed:
        more = f" and {len(renamed) - 3} more" if len(renamed) > 3 else ""
        warn_once(f"{scanner.path}: names must be unique, so it reads {', '.join(renamed[:3])}{more}")
    return Hierarchy(
        names=tuple(names),
        parents=tuple(node.parent for node in joints),
        offsets=tuple(node.offset or _ORIGIN for node in joints),
        channels=tuple(node.channels or () for node in joints),
        end_offsets={joint: node.offset or _ORIGIN for joint, node in ends.items()},
    )


def _open_joint(scanner: Scanner, joints: list[_Node], parent: int) -> _Node:
    """Read a joint's name and brace."""
    name = scanner.name()
    if len(joints) == MAX_JOINTS:
        scanner.fail(f"more than {MAX_JOINTS} joints, which is the most allowed")
    joints.append(_Node(name, len(joints), parent, scanner.line))
    scanner.expect("{")
    return joints[-1]


def _read_channels(scanner: Scanner, node: _Node) -> tuple[str, ...]:
    """Read a node's channels: ZXZ is an Euler order, ZZX is none; a position is given once."""
    most = 0 if node.is_end else MAX_CHANNELS
    number = scanner.word()
    if number not in map(str, range(most + 1)):
        scanner.fail(f"expected 0 to {most} CHANNELS in {node}, got {scanner.shown(number)}")
    channels = []
    for _ in range(int(number)):
        word = scanner.word()
        found = _CHANNEL.fullmatch(word)
        if found is None:
            scanner.fail(f"expected a channel as Xposition or Zrotation, got {scanner.shown(word)}")
        channels.append(found.group(1).upper() + found.group(2).lower())
    positions = [channel for channel in channels if channel.endswith("position")]
    turns = [channel for channel in channels if channel.endswith("rotation")]
    twice = any(a == b for a, b in pairwise(turns))
    if twice or len(turns) > 3 or len(set(positions)) < len(positions):
        scanner.fail(f"expected up to three positions and an Euler order, got {' '.join(channels)}")
    return tuple(channels)


_FRAMES = re.compile(r"\s*+frames[ \t]*+:?[ \t]*+([^\s:]+)", re.IGNORECASE)
_CUT_NUMBER = re.compile(r"[-+.0-9eEnaN]+")
_DATUM = re.compile(r"\S+", re.ASCII)  # a no-break space parts no numbers
_FRAME_TIME = re.compile(r"\s*+frame[ \t]*+time[ \t]*+:?[ \t]*+([^\s:]+)", re.IGNORECASE)


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
    first = scanner.text.count("\n", 0, scanner.stop) + 1
    for line, row in enumerate(scanner.text[scanner.stop :].split("\n"), first):
        if row and not row.isspace():
            yield line, row


def _find_fault(scanner: Scanner, labels: Sequence[str], *, may_wrap: bool, lossy: bool) -> FileFormatError | None:
    """Find the first value that is no number, or the first row of a wrong length (where rows may not be wrapped)."""
    read = 0
    for line, row in _iterate_rows(scanner):
        words = _DATUM.findall(row)
        for number, word in enumerate(words, read):
            if finite_number(word) is None and not (lossy and missing.is_nan(word)):
                frame, column = divmod(number, len(labels))
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
    def offset_line(offset: Offset) -> str:
        return " ".join(["OFFSET", *(f"{round(value, decimals) + 0.0:.{decimals}f}" for value in offset)])

    open_joints: list[int] = []
    for joint, parent in enumerate(hierarchy.parents):
        while open_joints and open_joints[-1] != parent:
            open_joints.pop()
            yield "\t" * len(open_joints) + "}"
        tab, channels = "\t" * len(open_joints), hierarchy.channels[joint]
        yield f"{tab}{'JOINT' if open_joints else 'ROOT'} {hierarchy.names[joint]}"
        yield f"{tab}{{"
        yield f"{tab}\t{offset_line(hierarchy.offsets[joint])}"
        yield f"{tab}\t{' '.join(['CHANNELS', str(len(channels)), *channels])}"
        if joint in hierarchy.end_offsets:
            end = offset_line(hierarchy.end_offsets[joint])
            yield from (f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\t{end}", f"{tab}\t}}")
        open_joints.append(joint)
    for depth in reversed(range(len(open_joints))):
        yield "\t" * depth + "}"


POSITIONS = ("Xposition", "Yposition", "Zposition")
ROTATIONS = ("Zrotation", "Xrotation", "Yrotation")
"""Channels of motions that came in no layout; the order most tools write."""
WRITTEN_UNITS = (0.01, 1.0, 0.001)
"""Units of motions that came in no layout, metres: the first in which the reader finds the body's size. Of the largest
and the smallest unit one is right for every size."""
STILL_METRES = 1e-6
"""Variation below which a joint needs no position channel."""
STILL_SHARE = 1e-6
"""A joint whose offset varies by less than this part of the body's reach stays still; files round to 1e-7."""


@dataclass(frozen=True, eq=False)
class BvhLayout(FileUnit):
    """Layout of a BVH file in `Motion.source`, so that it is written as it came."""

    hierarchy: Hierarchy
    """Joints with their channels and OFFSET lines, in the file's unit."""
    fps: Fraction
    """Frames per second that the frame time was read as."""
    frame_time: str
    """Frame time as printed, seconds."""
    encoding: str = "utf-8"
    """How names are encoded."""
    values: np.ndarray | None = None
    """(frames, channels) that were read, file unit and degrees, NaN where lost; what is unchanged is written so."""

    @property
    def decimals(self) -> int:
        """Digits after the point that keep a chain of bones within 0.01 mm."""
        return 6 if self.metres_per_unit < 0.02 else 8


def read(path: str | PathLike[str], *, lossy: bool) -> tuple[Motion, MissingValues]:
    """Read a BVH file of any Euler order, with 0 to 6 channels a joint, in any of the units of `units`.

    The root's translation is `root_position` and its offset in the skeleton is zero. Another joint's translation is its
    offset where it stays still, else `moving_offsets`. Some values of a `lossy` file may be NaN: the position of a
    joint that stays still is known in every frame if it is in one; if it is in none, it is at OFFSET. FileFormatError
    names what is wrong, in which line.
    """
    text, encoding = decode(path, read_bytes(path), "BVH text")
    scanner = Scanner(path, text)
    tree = read_hierarchy(scanner)
    word = scanner.match(_FRAMES, "'Frames: COUNT'")
    if not re.fullmatch(r"[+]?[0-9]{1,12}", word):
        scanner.fail(f"expected a positive number of frames, got {shorten(word)}")
    frames, frames_line = int(word), scanner.line
    frame_time = scanner.match(_FRAME_TIME, "'Frame Time: SECONDS'")
    seconds = finite_number(frame_time)
    if seconds is None or len(frame_time) > 60 or not SHORTEST_FRAME <= seconds <= LONGEST_FRAME:
        allowed = f"between {SHORTEST_FRAME:g} and {LONGEST_FRAME:g} s"
        scanner.fail(f"expected a frame time {allowed}, got {shorten(frame_time)}")
    own = _parse_values(scanner, tree.labels(), frames=frames, frames_line=frames_line, lossy=lossy)
    lost = np.isnan(own)
    missing.check_any_known(path, lost)
    check_extent(path, len(own), len(tree.names))
    values = _fill_missing(tree, own)
    _, rest, moving = _classify_translations(tree, values)
    unit = guess_unit(tree.names, tree.parents, rest, end_offsets=tree.end_offsets, moving=moving)
    layout = BvhLayout(**vars(unit), hierarchy=tree, fps=frame_rate(frame_time), frame_time=frame_time)
    layout = replace(layout, encoding=encoding, values=own)
    return _build_motion(layout, values), _find_missing(tree, lost, moving)


def _build_motion(layout: BvhLayout, values: np.ndarray) -> Motion:
    """Build the motion of channels (frames, channels) in the layout's order and unit."""
    tree, scale = layout.hierarchy, layout.metres_per_unit
    travels, rest, moving = _classify_translations(tree, values)
    ends = {tree.names[j]: (x * scale, y * scale, z * scale) for j, (x, y, z) in tree.end_offsets.items()}
    return Motion(
        skeleton=Skeleton(tree.names, tree.parents, torch.from_numpy(rest * scale), ends),
        fps=layout.fps,
        root_position=torch.from_numpy(travels[0] * scale),
        local_quat_xyzw=_quaternions(tree, values),
        moving_offsets={joint: torch.from_numpy(travels[joint] * scale) for joint in moving},
        source=layout,
    )


def _fill_missing(tree: Hierarchy, values: np.ndarray) -> np.ndarray:
    if not np.isnan(values).any():
        return values
    done = missing.hold_last(values)
    for joint, columns in enumerate(tree.position_columns()):
        own = list(columns.values())
        done[:, own] = missing.interpolate_nan(values[:, own], np.array(tree.offsets[joint])[list(columns)])
    return done


def _find_missing(tree: Hierarchy, lost: np.ndarray, moving: Sequence[int]) -> MissingValues:
    """Find the missing values by joint; a joint without channels is missing where all channels are. One known frame
    determines the position of a joint that stays still."""
    whole = np.all(lost, axis=1)
    rotations = np.tile(whole[:, None], len(tree.names))
    positions = np.zeros_like(rotations)
    positions[:, 0] = whole
    for _, joints, columns in tree.rotation_groups():
        rotations[:, joints] |= lost[:, columns].any(axis=-1)
    for joint, columns in enumerate(tree.position_columns()):
        own = lost[:, list(columns.values())]
        if joint == 0 or joint in moving or own.all(axis=0).any():
            positions[:, joint] |= own.any(axis=1)
    return MissingValues(torch.from_numpy(rotations), torch.from_numpy(positions))


def convert_unit(motion: Motion, metres_per_unit: float) -> Motion:
    """Return the motion as its file has it if a unit of the file is so many metres, whatever the file declares.

    A character of another size than its file's is none of that file any more.
    """
    source, old = motion.source, motion.skeleton
    scale = metres_per_unit / getattr(source, "metres_per_unit", 1.0)
    if isinstance(source, FileUnit):
        source = replace(source, metres_per_unit=metres_per_unit, unit_doubt="")
    elif scale == 1:
        return motion
    else:
        source = None
    ends = {name: (x * scale, y * scale, z * scale) for name, (x, y, z) in old.end_offsets.items()}
    return replace(
        motion,
        skeleton=Skeleton(old.names, old.parents, old.offsets * scale, ends),
        root_position=motion.root_position * scale,
        moving_offsets={joint: track * scale for joint, track in motion.moving_offsets.items()},
        source=source,
    )


def add_root_to_layout(source: object | None, name: str) -> BvhLayout | None:
    """Return the layout of a BVH file with a joint above its root, which has that one's channels if they are six, and
    stays still in the numbers that were read; None for what is no layout."""
    if not isinstance(source, BvhLayout):
        return None
    tree, values = source.hierarchy, source.values
    own = tree.channels[0] if len(tree.channels[0]) == len(POSITIONS + ROTATIONS) else POSITIONS + ROTATIONS
    above = Hierarchy(
        (name, *tree.names),
        (-1, *(parent + 1 for parent in tree.parents)),
        ((0.0, 0.0, 0.0), *tree.offsets),
        (own, *tree.channels),
        {joint + 1: offset for joint, offset in tree.end_offsets.items()},
    )
    still = None if values is None else np.concatenate([np.zeros((len(values), len(own))), values], axis=1)
    return replace(source, hierarchy=above, values=still)


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a BVH file, in the layout the motion was read in where its skeleton still has the same joints.

    Else in centimetres, or where a body of that size would be read in another unit in metres or millimetres, with root
    OFFSET 0, six channels on the root and on joints that travel, three elsewhere. A channel is added where the source's
    layout cannot hold the motion. Same motion, same bytes.
    RequestError where BVH has no form for its names or frame rate; then nothing is written.
    """
    layout = choose_layout(motion, path)
    order = [motion.skeleton.index(name) for name in layout.hierarchy.names]
    quat_xyzw = as_array(motion.local_quat_xyzw)[:, order]
    translations = all_translations(motion)[:, order] / layout.metres_per_unit
    tree = fit_hierarchy(layout, translations, quat_xyzw)
    values = _keep_source_values(layout, tree, translations, quat_xyzw)
    text = compose(tree, layout.frame_time, values, decimals=layout.decimals)
    write_bytes(path, text.encode(layout.encoding))


def _classify_translations(tree: Hierarchy, values: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray, list[int]]:
    """Return translations (frames, 3), file unit, of the root and of every joint with position channels, rest offsets
    (joints, 3) in the file's unit, and which joints travel within their parent.

    A channel that repeats OFFSET up to rounding is taken as OFFSET, so that clips of one rig agree.
    """
    travels, rest = {}, np.array(tree.offsets)
    for joint, columns in enumerate(tree.position_columns()):
        if columns or joint == 0:
            travels[joint] = np.tile(tree.offsets[joint], (len(values), 1))
            travels[joint][:, list(columns)] = values[:, list(columns.values())]
            rest[joint] = travels[joint][0]
    still, moving = STILL_SHARE * longest_chain_length(tree.parents, np.linalg.norm(rest, axis=1), {}), []
    for joint, track in travels.items():
        low, high, offset = track.min(0), track.max(0), np.array(tree.offsets[joint])
        if joint == 0:
            rest[joint] = 0.0
        elif (np.maximum(high - offset, offset - low) <= still).all():
            rest[joint] = offset
        elif (high - low <= still).all():
            rest[joint] = (low + high) / 2
        else:
            rest[joint] = offset
            moving.append(joint)
    return travels, rest, moving


def _quaternions(tree: Hierarchy, values: np.ndarray) -> Float[Tensor, "frames joints 4"]:
    """Return the local rotations, continuous in sign over time; joints of one Euler order at once."""
    quat_xyzw = np.empty((len(values), len(tree.names), 4))
    for axes, joints, columns in tree.rotation_groups():
        quat_xyzw[:, joints] = euler.to_quat_xyzw(np.deg2rad(values[:, columns]), axes)
    return rotations.make_sign_continuous(torch.from_numpy(quat_xyzw))


def channel_values(tree: Hierarchy, translations: np.ndarray, quat_xyzw: np.ndarray) -> np.ndarray:
    """Return the motion block (frames, channels), file unit and degrees."""
    values = np.zeros((len(quat_xyzw), len(tree.labels())))
    for joint, columns in enumerate(tree.position_columns()):
        values[:, list(columns.values())] = translations[:, joint, list(columns)]
    for axes, joints, columns in tree.rotation_groups():
        values[:, columns] = np.rad2deg(euler.from_quat_xyzw(quat_xyzw[:, joints], axes))
    return values


def _keep_source_values(
    layout: BvhLayout, tree: Hierarchy, translations: np.ndarray, quat_xyzw: np.ndarray
) -> np.ndarray:
    """Return the motion block, with the numbers that were read where a joint is unchanged.

    They are read again to compare: a motion's tensors may have been written into.
    """
    values, own, old = channel_values(tree, translations, quat_xyzw), layout.values, layout.hierarchy
    if own is None or len(own) != len(values):
        return values
    before = _build_motion(layout, _fill_missing(old, own))
    turns, positions = as_array(before.local_quat_xyzw), all_translations(before) / layout.metres_per_unit
    turned = (turns == quat_xyzw).all(-1) | (turns == -quat_xyzw).all(-1)
    there = np.all(np.isclose(positions, translations, rtol=1e-12, atol=1e-12), axis=-1)
    now, then = ((t.channels, t.position_columns(), t.rotation_columns()) for t in (tree, old))
    for joint, (channels, position, (axes, at)) in enumerate(zip(*now, strict=True)):
        if channels != then[0][joint]:
            continue
        numbers = own[:, list(then[1][joint].values())]
        kept = there[:, joint] & np.isfinite(numbers).all(-1)
        columns = list(position.values())
        values[:, columns] = np.where(kept[:, None], numbers, values[:, columns])
        numbers = own[:, then[2][joint][1]]
        kept = turned[:, joint] & np.isfinite(numbers).all(-1)
        if kept.any():
            values[:, at] = euler.keep_source_angles(values[:, at], numbers, kept, axes)
    return values


def all_translations(motion: Motion) -> np.ndarray:
    """Return translations (frames, joints, 3), metres: each joint in its parent's frame, the root in the world."""
    translations = np.tile(as_array(motion.skeleton.offsets), (motion.num_frames, 1, 1))
    translations[:, 0] = as_array(motion.root_position)
    for joint, track in motion.moving_offsets.items():
        translations[:, joint] = as_array(track)
    return translations


def check_finite(motion: Motion, path: str | PathLike[str]) -> None:
    """Raise RequestError, naming joint and frame, unless all positions and rotations can be written."""
    length = np.linalg.norm(as_array(motion.local_quat_xyzw), axis=-1)
    bad = ~np.isfinite(all_translations(motion)).all(-1) | ~(abs(length - 1) < 0.01)
    if bad.any():
        frame, joint = np.argwhere(bad)[0]
        what = f"{motion.skeleton.names[joint]} at frame {frame}"
        raise RequestError(f"cannot write {path}: {what} has no finite position and rotation")


def as_array(values: Tensor) -> np.ndarray:
    """Return a float64 array, wherever the tensor is."""
    return values.detach().cpu().double().numpy()


def choose_layout(motion: Motion, path: str | PathLike[str]) -> BvhLayout:
    """Choose the layout to write a motion in; RequestError where BVH has no form for its names or frame rate."""
    layout, skeleton = motion.source, motion.skeleton
    if not isinstance(layout, BvhLayout) or (layout.hierarchy.names, layout.hierarchy.parents) != (
        skeleton.names,
        skeleton.parents,
    ):  # it came in no layout, or its joints are others now
        layout = _default_layout(motion)
    if layout.fps != motion.fps or not layout.frame_time:
        if not SHORTEST_FRAME <= 1 / motion.fps <= LONGEST_FRAME:
            allowed = f"{1 / LONGEST_FRAME:g} to {1 / SHORTEST_FRAME:g}"
            raise RequestError(f"cannot write {path}: {float(motion.fps):g} frames per second, allowed are {allowed}")
        layout = replace(layout, fps=motion.fps, frame_time=f"{float(1 / motion.fps):.9f}")
    _check_names(layout, path)
    ends = {
        joint: _in_unit(skeleton.end_offsets[name], layout.metres_per_unit)
        for joint, name in enumerate(layout.hierarchy.names)
        if name in skeleton.end_offsets
    }
    return replace(layout, hierarchy=replace(layout.hierarchy, end_offsets=ends))


def fit_hierarchy(layout: BvhLayout, translations: np.ndarray, quat_xyzw: np.ndarray) -> Hierarchy:
    """Fit the layout's hierarchy to this motion, with channels added where a joint's own cannot hold it.

    `translations` (frames, joints, 3) in the file's unit, `quat_xyzw` (frames, joints, 4), joints in file order. OFFSET
    is the source's along axes with a channel, which replaces it, and the motion's along the others.
    """
    tree, still = layout.hierarchy, STILL_METRES / layout.metres_per_unit
    channels, offsets = [], []
    travel = np.ptp(translations, axis=0) > still
    for joint, columns in enumerate(tree.position_columns()):
        lacks = any(travel[joint, axis] and axis not in columns for axis in range(3))
        channels.append(_widen_channels(tree.channels[joint], quat_xyzw[:, joint : joint + 1], add_positions=lacks))
        axes = range(3) if lacks else columns
        own, wanted = tree.offsets[joint], translations[0, joint]
        offsets.append(tuple(own[axis] if axis in axes else float(wanted[axis]) for axis in range(3)))
    return replace(tree, channels=tuple(channels), offsets=tuple(offsets))


def _widen_channels(channels: tuple[str, ...], quat_xyzw: np.ndarray, *, add_positions: bool) -> tuple[str, ...]:
    turns = tuple(c for c in channels if c.endswith("rotation"))
    rotations = turns if euler.can_represent(quat_xyzw, [AXES[c[0]] for c in turns]) else ROTATIONS
    if not add_positions and rotations == turns:
        return channels
    return (POSITIONS if add_positions else tuple(c for c in channels if c not in turns)) + rotations


def _default_layout(motion: Motion) -> BvhLayout:
    """Return a layout with root OFFSET 0, joints depth first as BVH nests them (the canonical order is not)."""
    skeleton, moving, unit = motion.skeleton, motion.moving_offsets, _written_unit(motion)
    order = list(NodeTree({joint: skeleton.children(joint) for joint in range(motion.num_joints)}).walk(0))
    channels = [(POSITIONS if j == 0 or j in moving else ()) + ROTATIONS for j in order]
    offsets = [_in_unit(skeleton.offsets[j].tolist(), unit) if j else (0.0, 0.0, 0.0) for j in order]
    parents = [order.index(skeleton.parents[j]) if j else -1 for j in order]
    names = tuple(skeleton.names[j] for j in order)
    return BvhLayout(unit, Hierarchy(names, tuple(parents), tuple(offsets), tuple(channels), {}), motion.fps, "")


def _written_unit(motion: Motion) -> float:
    """Return the first of WRITTEN_UNITS in which the reader finds the body's size."""
    skeleton, offsets = motion.skeleton, as_array(motion.skeleton.offsets)
    for unit in WRITTEN_UNITS:
        ends = {skeleton.index(name): _in_unit(offset, unit) for name, offset in skeleton.end_offsets.items()}
        found = guess_unit(
            skeleton.names, skeleton.parents, offsets / unit, end_offsets=ends, moving=motion.moving_offsets
        )
        if found.metres_per_unit == unit:
            return unit
    return WRITTEN_UNITS[0]


def _in_unit(offset: Sequence[float], metres_per_unit: float) -> Offset:
    x, y, z = (value / metres_per_unit for value in offset)
    return x, y, z


def _check_names(layout: BvhLayout, path: str | PathLike[str]) -> None:
    """Refuse names that would not be read back: a name ends at a brace or a line's end and loses outer blanks."""
    for name in layout.hierarchy.names:
        broken = not name or name != name.strip() or any(mark in name for mark in "{}\r\n\0")
        if broken or name.encode(layout.encoding, "replace").decode(layout.encoding) != name:
            raise RequestError(f"cannot write {path}: BVH has no form for the joint name {shorten(name)}")
