"""ASF: the skeleton half of an Acclaim capture, in the file's own unit.

The file is sections that begin with a colon. `#` starts a comment; commas and brackets are blanks. What this library
has no use for (masses, limits, documentation) is passed over; everything that places a joint must be there and sound.
Source: Acclaim Skeleton File Definition V1.10 (M. Schafer, 1994), and Vicon's notes on it for angles and root.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import NoReturn

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.bvh import euler
from mapctl.formats.text import NUMBER, decode, finite_number, read_bytes, shorten

MAX_BONES = 1000
"""Most bones that are read; a body with fingers has about 60."""
_SECTIONS = frozenset((":version", ":name", ":units", ":documentation", ":root", ":bonedata", ":hierarchy", ":skin"))
_IGNORED = frozenset(("id", "bodymass", "cofmass", "limits"))
_ALLOWED_KEYS = "name, direction, length, axis, dof, limits or end"
_AXES = {"x": 0, "y": 1, "z": 2}
_UNIT_ERROR = 0.01
"""How far a direction's length may be from one: files round to a few digits."""

Row = tuple[int, list[str]]
"""Line number, from 1, and the words of a line."""


@dataclass(frozen=True, eq=False)
class AsfSkeleton:
    """Bones, the root first and every parent before its children. Lengths are in the file's unit."""

    names: tuple[str, ...]
    """Bone names as written; the first is `root`."""
    parents: tuple[int, ...]
    """Index of each bone's parent; -1 for the root."""
    ends: np.ndarray
    """(bones, 3) from each bone's start to its end at rest, in world axes; zero for the root."""
    axis_quat_xyzw: np.ndarray
    """(bones, 4) rotation of the frame that a bone's angles are about, at rest; for the root its pre-set rotation."""
    channels: tuple[tuple[str, ...], ...]
    """What an AMC line holds of each bone, as `tx` or `rz`; empty for a bone that never rotates."""
    root_position: np.ndarray
    """(3,) added to the root's position in every frame, file unit."""
    length: float
    """`length` of :units: so many units to the inch; 1 is no information."""
    degrees: bool
    """Whether angles are in degrees."""


def read(path: str | PathLike[str]) -> AsfSkeleton:
    """Read an ASF file. FileFormatError names the line and what was expected there."""
    return _Reader(path).read(decode(path, read_bytes(path), "ASF text")[0])


def rows(text: str) -> Iterator[Row]:
    """Return the lines of ASF or AMC text that hold words, without comments; commas and brackets are blanks."""
    for number, line in enumerate(text.split("\n"), start=1):
        if words := line.partition("#")[0].translate(_BLANKS).split():
            yield number, words


_BLANKS = str.maketrans(",()", "   ")


@dataclass
class _Bone:
    """A bone as far as it has been read."""

    line: int
    name: str = ""
    direction: np.ndarray | None = None
    length: float | None = None
    axis: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))
    channels: tuple[str, ...] = ()


class _Reader:
    def __init__(self, path: str | PathLike[str]):
        self.path = path
        self.degrees, self.length = True, 1.0

    def fail(self, message: str, line: int | None) -> NoReturn:
        raise FileFormatError(self.path, message, line)

    def read(self, text: str) -> AsfSkeleton:
        sections = self._sections(text)
        for name in (":root", ":bonedata", ":hierarchy"):
            if name not in sections:
                self.fail(f"has no section {name}", text.count("\n") + 1)
        self._units(sections.get(":units", []))
        root, position = self._root(sections[":root"])
        bones = [root, *self._bones(sections[":bonedata"])]
        index = self._index(bones)
        order, parents = self._tree(bones, index, sections[":hierarchy"])
        place = {bone: number for number, bone in enumerate(order)}
        kept = [bones[bone] for bone in order]
        return AsfSkeleton(
            names=tuple(bone.name for bone in kept),
            parents=tuple(place[parents[bone]] if bone else -1 for bone in order),
            ends=np.array([self._end(bone) for bone in kept]),
            axis_quat_xyzw=np.array([bone.axis for bone in kept]),
            channels=tuple(bone.channels for bone in kept),
            root_position=position,
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
                if name not in _SECTIONS:
                    self.fail(f"unknown section {shorten(words[0])}, allowed: {', '.join(sorted(_SECTIONS))}", line)
                if name in found:
                    self.fail(f"a second section {name}", line)
                current = found.setdefault(name, [])
                words = words[1:]
            if current is None:
                self.fail(f"expected a section as :version or :root, got {shorten(words[0])}", line)
            if words:
                current.append((line, words))
        return found

    def _units(self, section: Sequence[Row]) -> None:
        for line, words in section:
            key, value = words[0].lower(), words[1].lower() if len(words) == 2 else ""
            if key == "length":
                self.length = self._numbers(words[:2], line, 1)[0]  # some add the unit's name
                if not 1e-3 <= self.length <= 1e3:
                    self.fail(f"expected a length unit from 0.001 to 1000, got {self.length:g}", line)
            elif key == "angle":
                if value not in ("deg", "rad"):
                    self.fail(f"expected 'angle deg' or 'angle rad', got {shorten(' '.join(words))}", line)
                self.degrees = value == "deg"
            elif key != "mass":
                self.fail(f"expected mass, length or angle, got {shorten(words[0])}", line)

    def _root(self, section: Sequence[Row]) -> tuple[_Bone, np.ndarray]:
        """Read the root and its pre-set position."""
        root = _Bone(section[0][0] if section else 0, "root")
        told: dict[str, tuple[int, list[str]]] = {}
        for line, words in section:
            key = words[0].lower()
            if key not in ("order", "axis", "position", "orientation") or key in told:
                self.fail(f"expected order, axis, position and orientation once each, got {shorten(words[0])}", line)
            told[key] = line, words
        if "order" not in told:
            self.fail("the root has no order, as TX TY TZ RX RY RZ", section[-1][0] if section else None)
        line, words = told["order"]
        root.channels = self._channels(words, line, allowed="tr")
        if not root.channels:
            self.fail("expected the root's order as TX TY TZ RX RY RZ, got nothing", line)
        axes = self._axis_order(told["axis"][1][-1], told["axis"][0]) if "axis" in told else (0, 1, 2)
        if "orientation" in told:
            line, words = told["orientation"]
            root.axis = self._fixed_axes_quat(self._numbers(words, line, 3), axes)
        if "position" not in told:
            return root, np.zeros(3)
        line, words = told["position"]
        return root, np.array(self._numbers(words, line, 3))

    def _bones(self, section: Sequence[Row]) -> Iterator[_Bone]:
        bone, seen, after_limits = None, set(), False
        for line, words in section:
            key = words[0].lower()
            if key == "begin" and bone is None:
                bone, seen = _Bone(line), set()
            elif bone is None:
                self.fail(f"expected begin, got {shorten(words[0])}", line)
            elif key == "end":
                yield self._check_complete(bone, line)
                bone = None
            elif not (after_limits and _is_limit(words[0])):
                if key in seen:
                    self.fail(f"a second {key} in a bone", line)
                seen.add(key)
                self._take(bone, key, words, line)
                after_limits = key == "limits"
        if bone is not None:
            self.fail(f"the bone of line {bone.line} has no end", section[-1][0])

    def _take(self, bone: _Bone, key: str, words: list[str], line: int) -> None:
        """Read one line of a bone."""
        if key == "name":
            if len(words) != 2:
                self.fail(f"expected one name, got {shorten(' '.join(words[1:]))}", line)
            bone.name = words[1]
        elif key == "direction":
            bone.direction = self._direction(words, line)
        elif key == "length":
            bone.length = self._numbers(words, line, 1)[0]
            if bone.length < 0:
                self.fail(f"expected a length of 0 or more, got {bone.length:g}", line)
        elif key == "axis":
            if len(words) != 5:
                self.fail(f"expected three angles and an order as XYZ, got {len(words) - 1} words", line)
            bone.axis = self._fixed_axes_quat(self._numbers(words[:4], line, 3), self._axis_order(words[4], line))
        elif key == "dof":
            bone.channels = self._channels(words, line, allowed="r")
        elif key not in _IGNORED:
            self.fail(f"expected {_ALLOWED_KEYS}, got {shorten(words[0])}", line)

    def _check_complete(self, bone: _Bone, line: int) -> _Bone:
        lacks = [
            key
            for key, value in (("name", bone.name or None), ("direction", bone.direction), ("length", bone.length))
            if value is None
        ]
        if lacks:
            self.fail(f"the bone of line {bone.line} has no {' and no '.join(lacks)}", line)
        return bone

    def _index(self, bones: Sequence[_Bone]) -> dict[str, int]:
        """Index bones by name in lower case, as files are not strict about it."""
        found: dict[str, int] = {}
        for number, bone in enumerate(bones):
            if bone.name.lower() in found:
                self.fail(f"a second bone named {shorten(bone.name)}, names must be unique", bone.line)
            if number > MAX_BONES:
                self.fail(f"more than {MAX_BONES} bones, which is the most allowed", bone.line)
            found[bone.name.lower()] = number
        return found

    def _tree(self, bones: Sequence[_Bone], index: dict[str, int], section: Sequence[Row]):
        """Sort bones depth first in file order; also return the parent of each. The numbers are those of `bones`."""
        parents, children = {}, {}
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
                children.setdefault(above, []).append(bone)
        order, waiting = [], [0]
        while waiting:
            order.append(waiting.pop())
            waiting += reversed(children.get(order[-1], []))
        for number in sorted(set(range(len(bones))) - set(order))[:1]:
            bone = bones[number]
            self.fail(f"the bone {shorten(bone.name)} does not hang on the root in :hierarchy", bone.line)
        return order, parents

    def _end(self, bone: _Bone) -> np.ndarray:
        return np.zeros(3) if bone.direction is None or bone.length is None else bone.direction * bone.length

    def _direction(self, words: list[str], line: int) -> np.ndarray:
        vector = np.array(self._numbers(words, line, 3))
        norm = float(np.linalg.norm(vector))
        if norm and abs(norm - 1) > _UNIT_ERROR:
            self.fail(f"expected a direction of length 1, got one of {norm:g}", line)
        return vector

    def _channels(self, words: list[str], line: int, *, allowed: str) -> tuple[str, ...]:
        channels = tuple(word.lower() for word in words[1:])
        known = {kind + axis for kind in allowed for axis in _AXES}
        if set(channels) - known or len(set(channels)) < len(channels):
            wanted = " ".join(sorted(known, reverse=allowed != "r"))
            self.fail(f"expected of {wanted} each at most once, got {shorten(' '.join(words[1:]))}", line)
        return channels

    def _axis_order(self, word: str, line: int) -> tuple[int, ...]:
        if sorted(word.lower()) != ["x", "y", "z"]:
            self.fail(f"expected an axis order as XYZ, got {shorten(word)}", line)
        return tuple(_AXES[letter] for letter in word.lower())

    def _fixed_axes_quat(self, angles: Sequence[float], axes: tuple[int, ...]) -> np.ndarray:
        """Return the quaternion of three rotations about fixed axes: `angles` about x, y and z in the order that `axes`
        says."""
        radians = np.deg2rad(angles) if self.degrees else np.array(angles)
        return euler.to_quat_xyzw(radians[list(axes[::-1])], axes[::-1])

    def _numbers(self, words: list[str], line: int, count: int) -> list[float]:
        """Parse the words after the first as numbers."""
        values = [finite_number(word) for word in words[1:]]
        if len(values) != count or None in values:
            got = shorten(" ".join(words[1:]) or "nothing")
            self.fail(f"expected for {words[0].lower()} {count} of {NUMBER}, got {got}", line)
        return [value for value in values if value is not None]


def _is_limit(word: str) -> bool:
    """Return whether a line holds further limits: it begins with a number, which may be infinite."""
    try:
        float(word)
    except ValueError:
        return False
    return True
