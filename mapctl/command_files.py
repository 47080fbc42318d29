"""Steering scripts: CSV files of time_s, speed_mps, heading_deg and, if wanted, facing_deg."""

import csv
import io
import math
from os import PathLike

from mapctl.errors import FileFormatError
from mapctl.formats.reading import read_bytes, shorten
from mapctl.steering import CommandTrack, as_track

_NEEDED = ("time_s", "speed_mps", "heading_deg")
_ALLOWED = (*_NEEDED, "facing_deg")
_MOST_SPEED, _MOST_TIME, _MOST = 1000.0, 1e6, 1e6


def read_commands(path: str | PathLike[str]) -> CommandTrack:
    """The commands of a file. FileFormatError names file and line, and what was expected there."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FileFormatError(path, f"is not a text file; expected columns {','.join(_NEEDED)}") from None
    lines = [(number, words) for number, words in enumerate(csv.reader(io.StringIO(text)), start=1)
             if any(word.strip() for word in words)]  # fmt: skip
    names = [word.strip().lower() for word in lines[0][1]] if lines else []
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise FileFormatError(path, f"has no column {', '.join(missing)}; expected {','.join(_NEEDED)}", 1)
    unknown = [name for name in names if name not in _ALLOWED]
    if unknown or len(set(names)) < len(names):
        found = shorten(",".join(names))
        raise FileFormatError(path, f"found the columns {found}, expected {','.join(_ALLOWED)}, each once", 1)
    if len(lines) < 2:
        raise FileFormatError(path, "holds no commands")
    order = [names.index(name) for name in _ALLOWED if name in names]
    rows: list[tuple[float, ...]] = []
    for number, words in lines[1:]:
        row = _row(path, number, words, names, order)
        if rows and row[0] <= rows[-1][0]:
            raise FileFormatError(path, f"time_s must rise, got {row[0]:g} after {rows[-1][0]:g}", number)
        rows.append(row)
    return as_track(rows)


def _row(
    path: str | PathLike[str], number: int, words: list[str], names: list[str], order: list[int]
) -> tuple[float, ...]:
    """Values of a line, in the order of _ALLOWED."""
    if len(words) != len(names):
        raise FileFormatError(path, f"found {len(words)} values where {len(names)} belong", number)
    values = tuple(_number(path, number, names[at], words[at].strip()) for at in order)
    if not 0 <= values[0] <= _MOST_TIME:
        raise FileFormatError(path, f"time_s must lie between 0 and {_MOST_TIME:g}, got {values[0]:g}", number)
    if not 0 <= values[1] <= _MOST_SPEED:
        raise FileFormatError(path, f"speed_mps must lie between 0 and {_MOST_SPEED:g}, got {values[1]:g}", number)
    return values


def _number(path: str | PathLike[str], line: int, name: str, word: str) -> float:
    if name == "facing_deg" and not word:
        return math.nan  # as the direction of travel
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= _MOST:
        raise FileFormatError(path, f"{name} must be a number, got {shorten(word)}", line)
    return value
