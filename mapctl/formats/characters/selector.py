"""Which armature and animation of a file is meant: FILE#ARMATURE, FILE#ARMATURE/ANIMATION or FILE#/ANIMATION."""

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from mapctl.errors import FileFormatError
from mapctl.formats.text import warn_once
from mapctl.isolated.naming import find_name


@dataclass(frozen=True)
class CharacterPath:
    """A character's file and what is chosen of it."""

    file: Path
    """The file."""
    armature: str | None = None
    """Name of the armature; None where the file has one."""
    animation: str | None = None
    """Name of the animation; None for the first."""


def parse_character_path(path: str | PathLike[str]) -> CharacterPath:
    """Split FILE#ARMATURE/ANIMATION; a file whose own name holds a # is taken as it is if it exists."""
    text = os.fspath(path)
    name, mark, choice = text.rpartition("#")
    if not mark or Path(text).exists():
        return CharacterPath(Path(text))
    armature, _, animation = choice.partition("/")
    return CharacterPath(Path(name), armature or None, animation or None)


def choose_name(path: Path, names: Sequence[str], wanted: str | None, what: str, *, several: bool) -> int:
    """Return the index of the wanted name, or of the only or first one; `what` is `armature` or `animation`.

    FileFormatError lists the names where none is the wanted one, or several are there and one must be chosen.
    """
    try:
        return find_name(path.name, names, wanted, what, several=several)
    except LookupError as error:
        raise FileFormatError(path, error.args[0]) from None


def note_animation(chosen: CharacterPath, names: Collection[str], read: str | None) -> None:
    """Log which of an armature's animations was read, where there are others and the path chooses none."""
    others = [name for name in names if name != read]
    if chosen.animation is None and others:
        what = "its rest pose, none" if read is None else f"{read!r}, the first"
        another = f"{chosen.file.name}#{chosen.armature or ''}/{others[0]}"
        warn_once(f"{chosen.file}: reads {what} of {len(names)} animations; choose another as {another!r}")
