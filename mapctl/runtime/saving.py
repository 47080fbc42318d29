"""The one link from a motion down to the file formats: `Motion.save` calls the writer that is registered here.

So `mapctl.motion` imports no format. `mapctl` itself registers the writer, before any of its modules can be imported.
"""

from collections.abc import Callable
from os import PathLike
from typing import Any

Writer = Callable[[Any, str | PathLike[str]], None]
"""Writes a Motion to a path, in the format that the path's ending names."""

_writers: list[Writer] = []


def register_writer(writer: Writer) -> None:
    """Have motions saved by this function from now on."""
    _writers.append(writer)


def save(motion: Any, path: str | PathLike[str]) -> None:
    """Write a motion by the function that was registered last."""
    _writers[-1](motion, path)
