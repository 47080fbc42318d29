"""What every reader needs first: the bytes of an ordinary file, or one clear line why not."""

from os import PathLike
from pathlib import Path

from mapctl.errors import FileFormatError

MAX_FILE_BYTES = 512 * 2**20
"""Largest file that is read; an hour of a 60-joint capture at 60 fps is about 350 MB of BVH."""


def read_bytes(path: str | PathLike[str]) -> bytes:
    """The file's content. FileFormatError if it is missing, empty, too large or not an ordinary file."""
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
        return file.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"cannot be read: {error.strerror or error}") from error


def shorten(word: str, limit: int = 40) -> str:
    """A quoted, printable, bounded form of a piece of a file, for error messages."""
    return ascii(word if len(word) <= limit else word[: limit - 3] + "...")
