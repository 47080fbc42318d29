"""Acclaim captures to Motion: an ASF skeleton and an AMC take. A joint at the start of every bone has its rotation.

In an ASF a bone's rotation turns the bone itself, about an own frame C that is fixed in the parent's: the turn is
C R inverse(C). So in the rest pose every joint frame is aligned with the world, a joint's offset is its parent bone
from start to end, and the last bones' ends are End Sites. Bones of the root start at the root.

An ASF is sections that begin with a colon. `#` starts a comment; commas and brackets are blanks. What this library has
no use for (masses, limits, documentation) is passed over; everything that places a joint must be there and sound.
Source: Acclaim Skeleton File Definition V1.10 (M. Schafer, 1994), and Vicon's notes on it for angles and root.

In an AMC a frame is a line with its number and a line for each bone with the values that the skeleton's `dof` names. A
bone that a frame leaves out keeps its last values, at first those of the rest pose; not in a file that is
`:FULLY-SPECIFIED`, where only bones that it never names may be missing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import nan
from os import PathLike, fspath
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import euler, missing
from mapctl.formats.missing import MissingValues
from mapctl.formats.parts import NodeTree
from mapctl.formats.text import MAX_POSES, NUMBER, check_extent, decode, finite_number, read_bytes, shorten
from mapctl.formats.units import FASTEST, SLOWEST, FileUnit, guess_unit
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

USUAL_FPS = Fraction(120)
"""Frames per second of a file that does not state them: those of the CMU database."""
_INCH = 0.0254
"""Metres."""
MAX_BONES = 1000
"""Most bones that are read; a body with fingers has about 60."""
_SECTIONS = frozenset((":version", ":name", ":units", ":documentation", ":root", ":bonedata", ":hierarchy", ":skin"))
_KEYS = ("order", "position", "orientation", "name", "direction", "length", "axis", "dof")
"""First words of the rows that place a joint."""
_UNIT_ERROR = 0.01
"""How far a direction's length may be from one: files round to a few digits."""

Row = tuple[int, list[str]]
"""Line number, from 1, and the words of a line."""
_KEYWORDS = (
    ":fully-specified",
    ":force-all-joints-be-in-file",
    ":degrees",
    ":radians",
    ":samples-per-second",
    ":asf-file",
    ":asf-path",
    ":frame-range",
)


@dataclass(frozen=True, eq=False)
class Bone:
    """A bone of a skeleton; the root is one without length."""

    name: str
    """Name as written."""
    line: int
    """Line of the file on which it begins."""
    end: np.ndarray
    """(3,) from the bone's start to its end at rest, in world axes, file unit."""
    axis_quat_xyzw: np.ndarray
    """(4,) rotation of the frame that a bone's angles are about, at rest; for the root its pre-set rotation."""
    channels: tuple[str, ...]
    """Channels in an AMC line, as `tx` or `rz`; empty for a bone that never rotates."""


@dataclass(frozen=True, eq=False)
class AsfSkeleton:
    """Bones, the root first and every parent before its children. Lengths are in the file's unit."""

    bones: tuple[Bone, ...]
    """The root, then all others."""
    parents: tuple[int, ...]
    """Index of each bone's parent; -1 for the root."""
    root_position: np.ndarray
    """(3,) added to the root's position in every frame."""
    length: float
    """`length` of :units: so many units to the inch; 1 is no information."""
    degrees: bool

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(bone.name for bone in self.bones)

    def columns(self, kind: str) -> list[tuple[tuple[int, ...], list[int]]]:
        """Return by bone the axes of its channels of a kind, `t` or `r`, in file order, and their columns."""
        found, start = [], 0
        for bone in self.bones:
            wanted = [(channel, start + number) for number, channel in enumerate(bone.channels) if channel[0] == kind]
            found.append((tuple("xyz".index(channel[1]) for channel, _ in wanted), [column for _, column in wanted]))
            start += len(bone.channels)
        return found


def read(
    path: str | PathLike[str], *, lossy: bool, fps: Fraction | float | None = None
) -> tuple[Motion, MissingValues]:
    """Read `take.amc` with the skeleton beside it, or `subject.asf+take.amc`.

    Without a name the skeleton is the .asf of the same stem, else the only one in the folder. `fps` is frames per
    second, over those of the file; else `USUAL_FPS`. Lengths are in metres by the ASF's `length`, or where that is 1
    by the size of the body. Some values of a `lossy` take may be NaN. FileFormatError names the fault and its line.
    """
    if fps is not None and not SLOWEST <= fps <= FASTEST:
        raise RequestError(f"the frame rate must be {SLOWEST:g} to {FASTEST:g}, got {float(fps):g}")
    try:
        subject, take = find_paths(path)
    except OSError as error:  # as a name that is too long, or a folder that may not be listed
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error
    asf = _AsfReader(subject).read(decode(subject, read_bytes(subject), "ASF text")[0])
    values, degrees, own_fps = read_amc(take, asf, lossy=lossy)
    check_extent(take, len(values), len(asf.bones))
    lost = np.isnan(values)
    missing.check_any_known(take, lost)
    skeleton, unit = _build_skeleton(asf)
    axes, columns = asf.columns("t")[0]
    positions = np.zeros((len(values), 3))
    positions[:, list(axes)] = values[:, columns]
    positions = missing.interpolate_nan(positions, np.zeros(3)) + asf.root_position
    motion = Motion(
        skeleton=skeleton,
        fps=Fraction(fps or own_fps or USUAL_FPS).limit_denominator(100_000),
        root_position=torch.from_numpy(positions * unit.metres_per_unit),
        local_quat_xyzw=_quaternions(asf, missing.hold_last(values), degrees=degrees),
        source=unit,
    )
    # a bone without channels is missing where all channels are
    turns = [lost[:, own].any(axis=1) | lost.all(axis=1) for _, own in asf.columns("r")]
    moved = np.zeros((len(values), len(turns)), dtype=bool)
    moved[:, 0] = lost[:, columns].any(axis=1)
    return motion, MissingValues(torch.from_numpy(np.stack(turns, axis=1)), torch.from_numpy(moved))


def find_paths(path: str | PathLike[str]) -> tuple[Path, Path]:
    """Find the skeleton's and the motion's file. FileFormatError names the candidates where the first is not clear.

    In `folder/subject.asf+take.amc` the take lies in the same folder unless it names one; `subject.asf+.amc` are two
    files of one stem.
    """
    text, file = fspath(path), Path(path)
    cut = text.lower().find(".asf+")
    if cut >= 0 and not file.exists():
        subject, take = Path(text[: cut + 4]), Path(text[cut + 5 :])
        if take.name.lower() == ".amc":
            take = take.with_name(subject.stem + take.name)
        return subject, take if len(take.parts) > 1 else subject.parent / take
    if not file.is_file():
        read_bytes(file)  # raises what is wrong with it
    near = sorted(other for other in file.parent.iterdir() if other.suffix.lower() == ".asf" and other.is_file())
    same = [other for other in near if other.stem == file.stem]
    found = same or near
    if len(found) != 1:
        names = ", ".join(other.name for other in found[:8]) or "none"
        wanted = f"name one as {found[0].name if found else 'subject.asf'}+{file.name}"
        raise FileFormatError(path, f"needs the skeleton of its subject, an .asf; beside it: {names}; {wanted}")
    return found[0], file


def _build_skeleton(asf: AsfSkeleton) -> tuple[Skeleton, FileUnit]:
    """Build joints at the bones' starts, in metres; also return the file's unit."""
    names, parents = asf.names, list(asf.parents)
    ends = np.array([bone.end for bone in asf.bones])
    offsets = np.concatenate([np.zeros((1, 3)), ends[parents[1:]]])
    leaves = [bone for bone in range(1, len(parents)) if bone not in parents]
    unit = FileUnit(_INCH / asf.length)
    if asf.length == 1:
        unit = guess_unit(names, parents, offsets, end_offsets={bone: ends[bone].tolist() for bone in leaves})
    scale = unit.metres_per_unit
    sites = {names[bone]: tuple((ends[bone] * scale).tolist()) for bone in leaves}
    return Skeleton(names, asf.parents, torch.from_numpy(offsets * scale), sites), unit


def _quaternions(asf: AsfSkeleton, values: np.ndarray, *, degrees: bool) -> Float[Tensor, "frames joints 4"]:
    """Return the local rotations C R inverse(C), continuous in sign over time."""
    turns = np.empty((len(values), len(asf.bones), 4))
    for bone, (axes, columns) in enumerate(asf.columns("r")):
        angles = values[:, columns[::-1]]
        # About fixed axes the first named rotation comes first; about moving ones, last.
        turns[:, bone] = euler.to_quat_xyzw(np.deg2rad(angles) if degrees else angles, axes[::-1])
    frame = torch.from_numpy(np.array([bone.axis_quat_xyzw for bone in asf.bones]))
    about = rotations.multiply(rotations.multiply(frame, torch.from_numpy(turns)), rotations.inverse(frame))
    return rotations.make_sign_continuous(about)


def rows(text: str) -> Iterator[Row]:
    """Return the lines of ASF or AMC text that hold words, without comments; commas and brackets are blanks."""
    for number, line in enumerate(text.split("\n"), start=1):
        if words := line.partition("#")[0].translate(_BLANKS).split():
            yield number, words


_BLANKS = str.maketrans(",()", "   ")


class _AsfReader:
    """Reader of an ASF file. FileFormatError names the line and what was expected there."""

    def __init__(self, path: str | PathLike[str]):
        self.path = path
        self.degrees, self.length = True, 1.0

    def fail(self, message: str, line: int | None) -> NoReturn:
        raise FileFormatError(self.path, message, line)

    def read(self, text: str) -> AsfSkeleton:
        sections = self._sections(text)
        for line, words in sections.get(":units", []):
            key = words[0].lower()
            if key == "length":
                self.length = self._numbers((line, words[:2]), 1)[0]  # some add the unit's name
                if not 1e-3 <= self.length <= 1e3:
                    self.fail(f"expected a length unit from 0.001 to 1000, got {self.length:g}", line)
            elif key == "angle":
                if [word.lower() for word in words[1:]] not in (["deg"], ["rad"]):
                    self.fail(f"expected angle deg or angle rad, got {shorten(' '.join(words))}", line)
                self.degrees = words[1].lower() == "deg"
        root = self._rows(sections[":root"])
        if "order" not in root or len(root["order"][1]) < 2:
            self.fail("the root has no order, as TX TY TZ RX RY RZ", sections[":root"][-1][0])
        line, words = root.get("axis", (0, ["XYZ"]))
        angles, position = (
            self._numbers(root[key], 3) if key in root else [0.0, 0.0, 0.0] for key in ("orientation", "position")
        )
        axis = self._fixed_axes_quat(angles, words[-1], line)
        channels = self._channels(root["order"], allowed="tr")
        bones = [Bone("root", sections[":root"][0][0], np.zeros(3), axis, channels)]
        begun: list[Row] = []
        for line, words in sections[":bonedata"]:
            key = words[0].lower()
            if not begun and key != "begin":
                self.fail(f"expected begin, got {shorten(words[0])}", line)
            if key == "end":
                bones.append(self._bone(begun, line))
                begun = []
            elif begun and key == "begin":
                break
            else:
                begun.append((line, words))
        if begun:
            self.fail(f"the bone of line {begun[0][0]} has no end", begun[-1][0])
        order, parents = self._tree(bones, sections[":hierarchy"])
        index_of = {bone: number for number, bone in enumerate(order)}
        return AsfSkeleton(
            bones=tuple(bones[bone] for bone in order),
            parents=tuple(index_of[parents[bone]] if bone else -1 for bone in order),
            root_position=np.array(position),
            length=self.length,
            degrees=self.degrees,
        )

    def _sections(self, text: str) -> dict[str, list[Row]]:
        """Return rows by section; words behind a section's name, as in `:name body`, are its first row."""
        found: dict[str, list[Row]] = {}
        current: list[Row] | None = None
        for line, words in rows(text):
            name = words[0].lower()
            if name.startswith(":"):
                if name not in _SECTIONS or name in found:
                    self.fail(f"expected {', '.join(sorted(_SECTIONS))} once each, got {shorten(words[0])}", line)
                current = found.setdefault(name, [])
                words = words[1:]
            if current is None:
                self.fail(f"expected a section as :version or :root, got {shorten(words[0])}", line)
            if words:
                current.append((line, words))
        for name in (":root", ":bonedata", ":hierarchy"):
            if not found.get(name):
                self.fail(f"has no section {name}", text.count("\n") + 1)
        return found

    def _rows(self, section: Sequence[Row]) -> dict[str, Row]:
        """Return rows by their first word, those alone that place a joint."""
        found: dict[str, Row] = {}
        for line, words in section:
            key = words[0].lower()
            if key in found:
                self.fail(f"a second {key}", line)
            if key in _KEYS:
                found[key] = line, words
        return found

    def _bone(self, section: Sequence[Row], end: int) -> Bone:
        """Read what is between begin and end; masses and limits are passed over."""
        found, begun = self._rows(section), section[0][0]
        lacks = [key for key in ("name", "direction", "length") if key not in found]
        if lacks or len(found["name"][1]) != 2:
            self.fail(f"the bone of line {begun} has no {' and no '.join(lacks or ['single name'])}", end)
        direction, (length,) = np.array(self._numbers(found["direction"], 3)), self._numbers(found["length"], 1)
        norm = float(np.linalg.norm(direction))
        if length < 0 or (norm and abs(norm - 1) > _UNIT_ERROR):
            wanted = "expected a direction of length 1 and a length of 0 or more"
            self.fail(f"{wanted}, got {norm:g} and {length:g}", found["direction"][0])
        axis = np.array([0.0, 0.0, 0.0, 1.0])
        if "axis" in found:
            line, angles = found["axis"]
            axis = self._fixed_axes_quat(self._numbers((line, angles[:4]), 3), " ".join(angles[4:]), line)
        channels = self._channels(found["dof"], allowed="r") if "dof" in found else ()
        return Bone(found["name"][1][1], begun, direction * length, axis, channels)

    def _tree(self, bones: Sequence[Bone], section: Sequence[Row]) -> tuple[list[int], dict[int, int]]:
        """Sort bones depth first in file order; also return the parent of each. The numbers are those of `bones`.

        Files are not strict about the case of names.
        """
        index: dict[str, int] = {}
        for number, bone in enumerate(bones):
            if bone.name.lower() in index:
                self.fail(f"a second bone named {shorten(bone.name)}, names must be unique", bone.line)
            if number > MAX_BONES:
                self.fail(f"more than {MAX_BONES} bones, which is the most allowed", bone.line)
            index[bone.name.lower()] = number
        parents: dict[int, int] = {}
        children: dict[int, list[int]] = {number: [] for number in range(len(bones))}
        for line, words in section:
            if words[0].lower() in ("begin", "end") and len(words) == 1:
                continue
            for word in words:
                if word.lower() not in index:
                    self.fail(f"no bone {shorten(word)} in :bonedata", line)
            above, *below = (index[word.lower()] for word in words)
            for bone in below:
                if bone == 0 or bone in parents:
                    self.fail(f"{shorten(bones[bone].name)} has a second parent", line)
                parents[bone] = above
                children[above].append(bone)
        order = list(NodeTree(children).walk(0))
        for number in sorted(set(range(len(bones))) - set(order))[:1]:
            bone = bones[number]
            self.fail(f"the bone {shorten(bone.name)} does not hang on the root in :hierarchy", bone.line)
        return order, parents

    def _channels(self, row: Row, *, allowed: str) -> tuple[str, ...]:
        channels = tuple(word.lower() for word in row[1][1:])
        known = {kind + axis for kind in allowed for axis in "xyz"}
        if set(channels) - known or len(set(channels)) < len(channels):
            wanted = " ".join(sorted(known, reverse=allowed != "r"))
            self.fail(f"expected of {wanted} each at most once, got {shorten(' '.join(row[1][1:]))}", row[0])
        return channels

    def _fixed_axes_quat(self, angles: Sequence[float], order: str, line: int) -> np.ndarray:
        """Return the quaternion of rotations about fixed axes: `angles` about x, y and z in the `order` as XYZ."""
        if sorted(order.lower()) != ["x", "y", "z"]:
            self.fail(f"expected an axis order as XYZ, got {shorten(order)}", line)
        axes = tuple("xyz".index(letter) for letter in order.lower())[::-1]
        radians = np.deg2rad(angles) if self.degrees else np.array(angles)
        return euler.to_quat_xyzw(radians[list(axes)], axes)

    def _numbers(self, row: Row, count: int) -> list[float]:
        """Parse the words after the first as numbers."""
        line, words = row
        values = [finite_number(word) for word in words[1:]]
        if len(values) != count or None in values:
            got = shorten(" ".join(words[1:]) or "nothing")
            self.fail(f"expected for {words[0].lower()} {count} of {NUMBER}, got {got}", line)
        return [value for value in values if value is not None]


def read_amc(
    path: str | PathLike[str], skeleton: AsfSkeleton, *, lossy: bool
) -> tuple[np.ndarray, bool, Fraction | None]:
    """Read a take of the skeleton: values (frames, channels) in the order of its bones and channels, file units;
    whether angles are in degrees; frames per second, None where the file does not state them, as most do not.

    FileFormatError names the line and what was expected there. A `lossy` take may hold NaN among its values.
    """

    def fail(message: str, line: int) -> NoReturn:
        raise FileFormatError(path, message, line)

    counts = [len(bone.channels) for bone in skeleton.bones]
    starts = np.cumsum([0, *counts])[:-1].tolist()
    bones = {bone.name.lower(): number for number, bone in enumerate(skeleton.bones)}
    frames, values, line = list[tuple[int, int, set[int]]](), list[np.ndarray](), 1  # line, number, and bones of each
    degrees, fps, full = None, None, False
    for line, words in rows(decode(path, read_bytes(path), "AMC text")[0]):
        word, shown = words[0].lower(), shorten(words[0])
        if word.startswith(":"):
            if word not in _KEYWORDS or frames:
                allowed = "a frame's number or a bone" if frames else f"one of {', '.join(_KEYWORDS)}"
                fail(f"expected {allowed}, got {shown}", line)
            if word in (":degrees", ":radians"):
                if degrees is not None:
                    fail("a second word on the unit of angles", line)
                degrees = word == ":degrees"
            elif word == ":samples-per-second":
                fps = finite_number(words[1]) if len(words) == 2 else None
                if fps is None or not SLOWEST <= fps <= FASTEST:
                    got = shorten(" ".join(words[1:]))
                    fail(f"expected {SLOWEST:g} to {FASTEST:g} samples a second, got {got}", line)
            full = full or word == ":fully-specified"
        elif len(words) == 1 and word.isdecimal() and word.isascii():
            number = int(word) if len(word) <= 9 else -1
            if number < 0 or (frames and number != frames[-1][1] + 1):
                before = frames[-1][1] if frames else 0
                wanted = f"frame {before + 1} after frame {before}" if frames else "a frame's number"
                fail(f"expected {wanted}, got {shown}", line)
            if (len(frames) + 1) * max(sum(counts), len(bones)) > MAX_POSES:
                fail(f"more than {MAX_POSES} values, which is the most allowed", line)
            frames.append((line, number, set()))
            values.append(values[-1].copy() if values else np.zeros(sum(counts)))
        else:
            if not frames:
                fail(f"expected the number of the first frame, got {shown}", line)
            if word not in bones:
                fail(f"the skeleton has no bone {shown}", line)
            bone, (_, number, seen) = bones[word], frames[-1]
            if bone in seen:
                fail(f"a second line for {shown} in frame {number}", line)
            if len(words) - 1 != counts[bone]:
                fail(f"{shown} has {len(words) - 1} values, expected {counts[bone]}", line)
            for channel, text in enumerate(words[1:]):
                value = nan if lossy and missing.is_nan(text) else finite_number(text)
                if value is None:
                    got = f"{shorten(text)}{missing.missing_hint(text)}"
                    fail(f"{shown} {skeleton.bones[bone].channels[channel]}: expected {NUMBER}, got {got}", line)
                values[-1][starts[bone] + channel] = value
            seen.add(bone)
    if not frames:
        fail("holds no frame, expected a line with the number 1", line)
    for begun, number, seen in frames:
        if 0 not in seen:
            fail(f"frame {number} has no line for the root", begun)
        if full and seen != frames[0][2]:
            bone = shorten(skeleton.bones[min(seen ^ frames[0][2])].name)
            fail(f"not every frame up to {number} holds {bone}, but the file is declared fully specified", begun)
    rate = None if fps is None else Fraction(fps).limit_denominator(100_000)
    return np.stack(values), skeleton.degrees if degrees is None else degrees, rate
