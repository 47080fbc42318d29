"""First steps of every reader: the bytes of an ordinary file, its text and numbers, or one clear line why not."""

import csv
import io
import sys
from functools import lru_cache
from math import isfinite
from os import PathLike
from pathlib import Path

from mapctl.errors import FileFormatError

MAX_FILE_BYTES = 512 * 2**20
"""Largest file that is read; an hour of a 60-joint capture at 60 fps is about 350 MB of BVH."""
MAX_POSES = 2**25
"""Most frames times joints of one motion: a gigabyte of rotations. Joints without channels cost a file nothing."""
LARGEST_VALUE = 1e8
"""No length (file unit) or angle (degrees) of a capture comes near this, and squares stay exact."""
NUMBER = f"a finite number below {LARGEST_VALUE:g}"


def read_bytes(path: str | PathLike[str]) -> bytes:
    """Read the file's content; FileFormatError if it is missing, empty, too large or not an ordinary file."""
    check_ordinary(path)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error


def check_ordinary(path: str | PathLike[str]) -> None:
    """Raise FileFormatError unless this is an ordinary file that can be read, not empty and not too large."""
    file = Path(path)
    try:
        if file.is_dir():
            raise FileFormatError(path, "is a folder, expected a file")
        if not file.exists():
            raise FileFormatError(path, "no such file")
        if not file.is_file():
            # A pipe or a device may never end.
            raise FileFormatError(path, "is not an ordinary file")
        size = file.stat().st_size
        if size == 0:
            raise FileFormatError(path, "the file is empty")
        if size > MAX_FILE_BYTES:
            raise FileFormatError(path, f"has {size >> 20} MiB, allowed are {MAX_FILE_BYTES >> 20}")
        with file.open("rb"):
            pass
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error


def shorten(word: str, limit: int = 40) -> str:
    """Quote a piece of a file for an error message: printable, of bounded length."""
    return ascii(word if len(word) <= limit else word[: limit - 3] + "...")


def one_line(error: Exception | str, limit: int = 160) -> str:
    """Shorten a library's message to one printable line: some quote pieces of the file."""
    text = " ".join(str(error).split())
    return text if text.isprintable() and len(text) <= limit else shorten(text, limit)


@lru_cache(maxsize=256)
def warn_once(message: str) -> None:
    """Log one line on standard error on what was read otherwise than declared in the file; once."""
    print(f"mapctl: {message}", file=sys.stderr)


def decode(path: str | PathLike[str], raw: bytes, expected: str) -> tuple[str, str]:
    """Decode text to plain line feeds; also return its encoding. Names in an old one-byte encoding are kept as latin-1.

    `expected` is what a binary file was taken for, as "BVH text".
    """
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise FileFormatError(path, "is UTF-16 text; save it as UTF-8", line=1)
    if b"\0" in raw:
        line = raw.count(b"\n", 0, raw.index(b"\0")) + 1
        raise FileFormatError(path, f"is a binary file, expected {expected}", line)
    try:
        text, encoding = raw.decode("utf-8-sig"), "utf-8"
    except UnicodeDecodeError:
        text, encoding = raw.decode("latin-1"), "latin-1"
    return text.replace("\r\n", "\n").replace("\r", "\n"), encoding


def read_table(path: str | PathLike[str], expected: str) -> list[tuple[int, list[str]]]:
    """Read the rows of a CSV that hold anything, each with its line, values without outer blanks.

    `expected` describes the table, for messages. FileFormatError for what is no table of text.
    """
    text, encoding = decode(path, read_bytes(path), expected)
    if encoding != "utf-8":
        raise FileFormatError(path, f"is not a text file in UTF-8, expected {expected}")
    table, rows = csv.reader(io.StringIO(text), strict=True), []
    try:
        for words in table:
            if any(word.strip() for word in words):
                rows.append((table.line_num, [word.strip() for word in words]))
    except csv.Error as error:
        raise FileFormatError(path, f"is no sound CSV ({error}), expected {expected}", table.line_num or 1) from None
    return rows


def check_extent(path: str | PathLike[str], frames: int, joints: int) -> None:
    """Raise FileFormatError where the rotations of so many frames and joints would fill the memory."""
    if frames * joints > MAX_POSES:
        raise FileFormatError(path, f"{frames} frames of {joints} joints, allowed are {MAX_POSES} in all")


def finite_number(word: str) -> float | None:
    """Return the number in a word, or None if it is none, not finite or absurd; `1_000` is none in a file."""
    try:
        value = float(word)
    except ValueError:
        return None
    plain = word.isascii() and "_" not in word
    return value if plain and isfinite(value) and abs(value) < LARGEST_VALUE else None
