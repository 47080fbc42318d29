"""Curves in CSV tables of metres, read as plain points."""

import math
from os import PathLike
from pathlib import Path

import numpy as np
from numpy import ndarray

from mapctl.curves.polyline import MAX_LENGTH, MAX_POINTS
from mapctl.errors import FileFormatError
from mapctl.formats.text import read_bytes, shorten


def read_text(path: str | PathLike[str], limit: int, expected: str) -> str:
    """Read the file's text, of `limit` bytes at most; FileFormatError for what is no text, with what was expected."""
    if Path(path).is_file() and Path(path).stat().st_size > limit:
        raise FileFormatError(path, f"is larger than {limit // 2**20} MiB, too large for a curve")
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise FileFormatError(path, f"is not a text file; expected {expected}")
    return text


MAX_CSV_BYTES = 64 * 2**20
"""Largest table that is read."""

_COLUMNS = (("x", "z"), ("x", "y", "z"))
_EXPECTED = "columns x,z or x,y,z in metres"


def read_csv(path: str | PathLike[str]) -> ndarray:
    """Read points (n, 2) as x, z or (n, 3) as x, y, z from a table, metres.

    Delimiters: comma, semicolon (then a decimal comma is understood), tab or blanks. A header is optional and may order
    the columns; blank lines and lines from `#` on are skipped. FileFormatError names file and line.
    """
    rows, order = [], None
    for number, line in enumerate(read_text(path, MAX_CSV_BYTES, _EXPECTED).splitlines(), start=1):
        words = _split_line(line)
        if not words:
            continue
        if order is None:
            order = _parse_header(path, words, number)
            if order is not None:
                continue
            order = _default_column_order(path, words, number)
        if len(rows) == MAX_POINTS:
            raise FileFormatError(path, f"more than {MAX_POINTS} points", number)
        rows.append(_parse_row(path, words, number, len(order)))
    if not rows:
        raise FileFormatError(path, f"holds no points; expected {_EXPECTED}")
    return np.array(rows)[:, order]


def _split_line(line: str) -> list[str]:
    line = line.partition("#")[0].strip()
    if ";" in line:
        words = line.replace(",", ".").split(";")
    elif "," in line:
        words = line.split(",")
    else:
        words = line.split("\t") if "\t" in line else line.split()
    return [word.strip().strip('"') for word in words] if line else []


def _parse_header(path: str | PathLike[str], words: list[str], number: int) -> list[int] | None:
    """Parse which columns are x, (y,) z; None if the line is no header."""
    if any(_is_number(word) for word in words):
        return None
    names = [word.lower() for word in words]
    for columns in _COLUMNS:
        if sorted(names) == list(columns):
            return [names.index(column) for column in columns]
    raise FileFormatError(path, f"found the columns {shorten(','.join(words))}, expected {_EXPECTED}", number)


def _default_column_order(path: str | PathLike[str], words: list[str], number: int) -> list[int]:
    if len(words) not in map(len, _COLUMNS):
        raise FileFormatError(path, f"found {len(words)} column{'s' * (len(words) != 1)}, expected {_EXPECTED}", number)
    return list(range(len(words)))


def _parse_row(path: str | PathLike[str], words: list[str], number: int, columns: int) -> list[float]:
    if len(words) != columns:
        raise FileFormatError(path, f"found {len(words)} values where {columns} belong", number)
    values = [float(word) if _is_number(word) else math.nan for word in words]
    if all(abs(value) <= MAX_LENGTH for value in values):
        return values
    wrong = next(word for word in words if not (_is_number(word) and abs(float(word)) <= MAX_LENGTH))
    expected = f"expected a number up to {MAX_LENGTH:g} (metres)"
    raise FileFormatError(path, f"{expected}, got {shorten(wrong)}", number)


def _is_number(word: str) -> bool:
    """Return whether the word is a number, nan and inf included: those are refused by their size. `1_000` is none."""
    try:
        float(word)
    except ValueError:
        return False
    return word.isascii() and "_" not in word
