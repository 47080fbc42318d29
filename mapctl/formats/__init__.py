"""Reading and writing motions in file formats, chosen by the ending; each module owns its format's quirks."""

from dataclasses import replace
from fractions import Fraction
from importlib import import_module
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import examples
from mapctl.formats.parts import parse_character_path

if TYPE_CHECKING:  # readers in a sandbox import this package without torch
    from mapctl.formats.missing import MissingValues
    from mapctl.mesh.character_mesh import CharacterMesh
    from mapctl.motion import Motion

USD_WRITTEN = (".usda", ".usdc", ".usd")
"""Endings of USD files that are written."""
_USD_ENDINGS = (*USD_WRITTEN, ".usdz")
READERS = {
    ".bvh": "bvh",
    ".npz": "npz",
    ".amc": "acclaim",
    **dict.fromkeys((".glb", ".gltf", ".vrm", ".vrma"), "gltf"),
    **dict.fromkeys(_USD_ENDINGS, "usd"),
    ".fbx": "fbx",
}
"""Endings that are read, each with its module of this package, which is imported when it is needed."""
WRITERS = {
    ".bvh": "bvh",
    ".npz": "npz",
    **dict.fromkeys((".glb", ".vrm", ".vrma"), "gltf"),
    **dict.fromkeys(USD_WRITTEN, "usd"),
}
"""Endings that are written, likewise."""
CHARACTERS = (".glb", ".gltf", ".vrm", ".vrma", *_USD_ENDINGS, ".fbx")
"""Endings of files of characters, that have a rest pose of their own."""
_MAY_LACK_VALUES = (".bvh", ".npz", ".amc")
_ONLY_READ = (".fbx", ".gltf", ".usdz", ".amc")
_UNREADABLE_REASONS = {".asf": "is a skeleton alone: name its motion, a .amc beside it or subject.asf+take.amc"}


def load(
    path: str | PathLike[str], *, fps: Fraction | float | None = None, metres_per_unit: float | None = None
) -> "Motion":
    """Read a motion from a file of `READERS`, an .amc with the .asf beside it (see `acclaim.load`).

    Of a character's file it is an animation, or one frame of the rest pose where there is none; `hero.glb#ARMATURE`,
    `hero.glb#ARMATURE/ANIMATION` and `hero.glb#/ANIMATION` choose where there are several. `fps` is frames per second
    of an .amc, which does not say; RequestError with the others, which do. `metres_per_unit` wins over what is found
    by the size of the body, and over what the file declares. `example:NAME` is a motion that mapctl brings along.
    FileFormatError says what is wrong with the file, and where: NaN in place of a number, too, which
    `load_with_missing` takes.
    """
    ending = _check_readable(path)
    if fps is not None and ending != ".amc":
        raise RequestError(f"{path}: a {ending} file says its frame rate itself; only that of an .amc is asked for")
    reader, file = _import_format(READERS[ending]), examples.resolve(path)
    motion = reader.load(file) if fps is None else reader.load(file, fps=fps)
    return _finish(motion, path, metres_per_unit)


def load_rest(path: str | PathLike[str]) -> "Motion | None":
    """Read one frame of a character's rest pose; None for files that have none but their motion."""
    ending = _check_readable(path)
    return _import_format(READERS[ending]).load_rest(path) if ending in CHARACTERS else None


def load_mesh(path: str | PathLike[str]) -> "CharacterMesh":
    """Read the triangles of a character's file, in its rest pose; FileFormatError where it has none."""
    ending = _check_readable(path)
    if ending not in CHARACTERS:
        raise FileFormatError(path, f"is no character's file; those end as {', '.join(CHARACTERS)}")
    return _import_format(READERS[ending]).load_mesh(path)


def ending_of(path: str | PathLike[str]) -> str:
    """Return a path's ending in lower case, without what it chooses of a character's file."""
    return parse_character_path(examples.resolve(path)).file.suffix.lower()


def _import_format(name: str) -> ModuleType:
    return import_module(f"mapctl.formats.{name}")


def load_with_missing(
    path: str | PathLike[str], *, metres_per_unit: float | None = None
) -> "tuple[Motion, MissingValues]":
    """Read a motion as `load` does, from a file that may have NaN for missing values; also return where they are.

    The motion is finite: missing rotations repeat the last known one, missing positions are interpolated linearly.
    FileFormatError where nothing is known.
    """
    ending = _check_readable(path)
    if ending not in _MAY_LACK_VALUES:
        motion = load(path, metres_per_unit=metres_per_unit)
        return motion, _import_format("missing").MissingValues.none(motion.num_frames, motion.num_joints)
    motion, missing = _import_format(READERS[ending]).load_with_missing(examples.resolve(path))
    return _finish(motion, path, metres_per_unit), missing


def _finish(motion: "Motion", path: str | PathLike[str], metres_per_unit: float | None) -> "Motion":
    """Convert the unit where one is given; mark examples with their licence, which BVH has no place for."""
    motion = replace(motion, licence=examples.LICENCE) if examples.is_example(path) else motion
    return motion if metres_per_unit is None else _import_format("bvh").convert_unit(motion, metres_per_unit)


def _check_readable(path: str | PathLike[str]) -> str:
    """Return the ending; FileFormatError unless it is one of `READERS`."""
    ending = ending_of(path)
    if ending not in READERS:
        why = _UNREADABLE_REASONS.get(ending, f"cannot read the ending {ending!r}")
        raise FileFormatError(path, f"{why}; allowed: {', '.join(READERS)}")
    return ending


def save(motion: "Motion", path: str | PathLike[str]) -> None:
    """Write a motion in a format of `WRITERS`, whole or not at all. RequestError if it cannot be written there."""
    check_ending(path)
    _import_format(WRITERS[Path(path).suffix.lower()]).save(motion, path)


def check_ending(path: str | PathLike[str]) -> None:
    """Raise RequestError unless `path` ends as a format that can be written, and is installed; to fail before long
    work."""
    ending = Path(path).suffix.lower()
    if ending not in WRITERS:
        why = f"{ending} is read but not written" if ending in _ONLY_READ else f"unknown ending {ending!r}"
        raise RequestError(f"cannot write {path}: {why}; allowed: {', '.join(WRITERS)}")
    if ending in USD_WRITTEN:
        _import_format("usd").check_installed(path)
