"""Motions that mapctl brings along, to try its commands on: `example:NAME` in place of a file."""

import os
from os import PathLike
from pathlib import Path

from mapctl.errors import RequestError

PREFIX = "example:"
"""What a name begins with that is no file's."""
LICENCE = "free for any use"
"""Licence of all of them: the free weights made them (LICENSE.md beside the files)."""
_FOLDER = Path(__file__).resolve().parents[1] / "examples"


def list_examples() -> tuple[str, ...]:
    """List the names."""
    return tuple(sorted(file.stem for file in _FOLDER.glob("*.bvh")))


def is_example(path: str | PathLike[str]) -> bool:
    """Return whether a path names one of them, or would."""
    return os.fspath(path).startswith(PREFIX)


def resolve(path: str | PathLike[str]) -> str | PathLike[str]:
    """Return the file of `example:NAME`; any other path as it is. RequestError where there is no such example."""
    if not is_example(path):
        return path
    name = os.fspath(path).removeprefix(PREFIX)
    if name not in list_examples():
        raise RequestError(f"there is no example {name!r}; there are: {', '.join(list_examples())}")
    return _FOLDER / f"{name}.bvh"
