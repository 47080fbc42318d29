"""AMC: the motion half of an Acclaim capture, as a table of numbers in the file's own units.

A frame is a line with its number and a line for each bone with the values that the skeleton's `dof` names. A bone
that a frame leaves out keeps its last values, at first those of the rest pose; not in a file that says it is
`:FULLY-SPECIFIED`, where only bones that it never names may be missing.
"""

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import nan
from os import PathLike
from typing import NoReturn

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats import missing
from mapctl.formats.acclaim.asf import AsfSkeleton, Row, rows
from mapctl.formats.frame_rate import FASTEST, SLOWEST
from mapctl.formats.text import MAX_POSES, NUMBER, decode, finite_number, read_bytes, shorten

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
class AmcText:
    """Content of an AMC file."""

    values: np.ndarray
    """(frames, channels) in the order of the skeleton's bones and channels, file units."""
    degrees: bool | None
    """Whether angles are in degrees; None where the file does not say."""
    fps: Fraction | None
    """Frames per second; None where the file does not say, as most do not."""


def read(path: str | PathLike[str], skeleton: AsfSkeleton, *, lossy: bool = False) -> AmcText:
    """Read a take of the skeleton. FileFormatError names the line and what was expected there.

    A `lossy` one may hold NaN among its values, but not only NaN.
    """
    reader = _Reader(path, skeleton, lossy)
    reader.read(rows(decode(path, read_bytes(path), "AMC text")[0]))
    values = np.frombuffer(reader.values).reshape(reader.frames, reader.width)
    return AmcText(values, reader.degrees, reader.fps)


@dataclass
class _Reader:
    path: str | PathLike[str]
    skeleton: AsfSkeleton
    lossy: bool = False
    degrees: bool | None = None
    fps: Fraction | None = None
    full: bool = False
    frames: int = 0
    """Number of frames begun so far."""
    number: int = 0
    """Number of the current frame, as the file counts."""
    line: int = 0
    """Line at which the current frame began."""
    values: array = field(default_factory=lambda: array("d"))
    seen: set[int] = field(default_factory=set)
    """Bones of the current frame so far."""
    expected_bones: set[int] = field(default_factory=set)
    """Bones of the first frame; in a fully specified file those of all."""

    def __post_init__(self):
        counts = [len(channels) for channels in self.skeleton.channels]
        starts = np.cumsum([0, *counts])[:-1].tolist()
        self.width = sum(counts)
        names = [name.lower() for name in self.skeleton.names]
        self.columns = dict(zip(names, zip(range(len(names)), starts, counts, strict=True), strict=True))
        self.row = array("d", bytes(8 * self.width))

    def fail(self, message: str, line: int) -> NoReturn:
        raise FileFormatError(self.path, message, line)

    def read(self, lines: Iterator[Row]) -> None:
        line = 1
        for line, words in lines:
            if words[0].startswith(":"):
                self._keyword(words, line)
            elif len(words) == 1 and words[0].isdecimal() and words[0].isascii():
                self._finish()
                self._begin(words[0], line)
            else:
                self._bone(words, line)
        if not self.frames:
            self.fail("holds no frame, expected a line with the number 1", line)
        self._finish()

    def _keyword(self, words: Sequence[str], line: int) -> None:
        word = words[0].lower()
        if word not in _KEYWORDS or self.frames:
            allowed = "a frame's number or a bone" if self.frames else f"one of {', '.join(_KEYWORDS)}"
            self.fail(f"expected {allowed}, got {shorten(words[0])}", line)
        if word in (":degrees", ":radians"):
            if self.degrees is not None:
                self.fail("a second word on the unit of angles", line)
            self.degrees = word == ":degrees"
        elif word == ":samples-per-second":
            self.fps = self._rate(words, line)
        elif word == ":fully-specified":
            self.full = True

    def _rate(self, words: Sequence[str], line: int) -> Fraction:
        value = finite_number(words[1]) if len(words) == 2 else None
        if value is None or not SLOWEST <= value <= FASTEST:
            got = shorten(" ".join(words[1:]))
            self.fail(f"expected {SLOWEST:g} to {FASTEST:g} samples a second, got {got}", line)
        return Fraction(value).limit_denominator(100_000)

    def _begin(self, word: str, line: int) -> None:
        number = int(word) if len(word) <= 9 else -1
        if number < 0 or (self.frames and number != self.number + 1):
            expected = f"frame {self.number + 1} after frame {self.number}" if self.frames else "a frame's number"
            self.fail(f"expected {expected}, got {shorten(word)}", line)
        self.frames, self.number, self.line, self.seen = self.frames + 1, number, line, set()
        if self.frames * max(self.width, len(self.columns)) > MAX_POSES:
            self.fail(f"more than {MAX_POSES} values, which is the most allowed", line)

    def _bone(self, words: Sequence[str], line: int) -> None:
        if not self.frames:
            self.fail(f"expected the number of the first frame, got {shorten(words[0])}", line)
        if words[0].lower() not in self.columns:
            self.fail(f"the skeleton has no bone {shorten(words[0])}", line)
        bone, start, count = self.columns[words[0].lower()]
        if bone in self.seen:
            self.fail(f"a second line for {shorten(words[0])} in frame {self.number}", line)
        if len(words) - 1 != count:
            self.fail(f"{shorten(words[0])} has {len(words) - 1} values, expected {count}", line)
        for column, word in enumerate(words[1:], start):
            value = nan if self.lossy and missing.is_nan(word) else finite_number(word)
            if value is None:
                channel = self.skeleton.channels[bone][column - start]
                got = f"{shorten(word)}{missing.missing_hint(word)}"
                self.fail(f"{shorten(words[0])} {channel}: expected {NUMBER}, got {got}", line)
            self.row[column] = value
        self.seen.add(bone)

    def _finish(self) -> None:
        """Keep the frame that has been read, if any."""
        if not self.frames:
            return
        if 0 not in self.seen:
            self.fail(f"frame {self.number} has no line for the root", self.line)
        if self.frames == 1:
            self.expected_bones = self.seen
        if self.full and self.seen != self.expected_bones:
            bone = self.skeleton.names[min(self.seen ^ self.expected_bones)]
            self.fail(
                f"not every frame up to {self.number} holds {shorten(bone)}, but the file says it is fully specified",
                self.line,
            )
        self.values.extend(self.row)
