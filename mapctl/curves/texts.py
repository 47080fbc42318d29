"""The text of a curve's file."""

from os import PathLike
from pathlib import Path

from mapctl.errors import FileFormatError
from mapctl.formats.text import read_bytes


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
