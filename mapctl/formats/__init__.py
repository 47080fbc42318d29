"""Reading and writing motions in file formats, chosen by the ending; each module owns its format's quirks."""

from dataclasses import replace
from fractions import Fraction
from importlib import import_module
from importlib.util import find_spec
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
_GLTF, _USD = (".glb", ".gltf", ".vrm", ".vrma"), (*USD_WRITTEN, ".usdz")
CHARACTERS = (*_GLTF, *_USD, ".fbx")
"""Endings of files of characters, that have a rest pose of their own."""
_MAY_LACK_VALUES = {".bvh": "bvh", ".npz": "npz", ".amc": "acclaim"}
READERS = {**_MAY_LACK_VALUES, **dict.fromkeys(_GLTF, "gltf"), **dict.fromkeys(_USD, "usd"), ".fbx": "fbx"}
"""Endings that are read, each with its module of this package, which is imported when it is needed."""
_ONLY_READ = (".fbx", ".gltf", ".usdz", ".amc")
WRITERS = {ending: module for ending, module in READERS.items() if ending not in _ONLY_READ}
"""Endings that are written, likewise."""
_NEEDED = {
    "pxr": "USD needs the package usd-core: pip install 'mapctl[usd]'",
    "ufbx": "FBX needs the package ufbx: pip install 'mapctl[fbx]'",
}


def load(
    path: str | PathLike[str], *, fps: Fraction | float | None = None, metres_per_unit: float | None = None
) -> "Motion":
    """Read a motion from a file of `READERS`, an .amc with the .asf beside it (see `acclaim.read`).

    Of a character's file it is an animation, or one frame of the rest pose where there is none; `hero.glb#ARMATURE`,
    `hero.glb#ARMATURE/ANIMATION` and `hero.glb#/ANIMATION` choose where there are several. `fps` is frames per second
    of an .amc, which does not state it; RequestError with the others, which do. `metres_per_unit` wins over what is
    found by the size of the body, and over what the file declares. `example:NAME` is a motion that mapctl brings along.
    FileFormatError names the fault of the file, and where: NaN in place of a number, too, which `load_with_missing`
    takes.
    """
    reader, ending = _find_reader(path), ending_of(path)
    if fps is not None and ending != ".amc":
        raise RequestError(f"{path}: a {ending} file has a frame rate of its own; only that of an .amc is requested")
    if ending in CHARACTERS:
        from mapctl.formats import character

        motion = character.load_motion(path, reader.read_character)
    else:
        options = {} if fps is None else {"fps": fps}
        motion, _ = reader.read(examples.resolve(path), lossy=False, **options)
    return _finish(motion, path, metres_per_unit)


def load_rest(path: str | PathLike[str]) -> "Motion | None":
    """Read one frame of a character's rest pose; None for files that have none but their motion."""
    reader, ending = _find_reader(path), ending_of(path)
    if ending not in CHARACTERS:
        return None
    from mapctl.formats import character

    return character.load_rest(path, reader.read_character)


def load_mesh(path: str | PathLike[str]) -> "CharacterMesh":
    """Read the triangles of a character's file, in its rest pose; FileFormatError where it has none."""
    reader, ending = _find_reader(path), ending_of(path)
    if ending not in CHARACTERS:
        raise FileFormatError(path, f"is no character's file; those end as {', '.join(CHARACTERS)}")
    from mapctl.formats import character

    return character.load_mesh(path, reader.read_character)


def ending_of(path: str | PathLike[str]) -> str:
    """Return a path's ending in lower case, without what it chooses of a character's file."""
    return parse_character_path(examples.resolve(path)).file.suffix.lower()


def load_with_missing(
    path: str | PathLike[str], *, metres_per_unit: float | None = None
) -> "tuple[Motion, MissingValues]":
    """Read a motion as `load` does, from a file that may have NaN for missing values; also return where they are.

    The motion is finite: missing rotations repeat the last known one, missing positions are interpolated linearly.
    FileFormatError where nothing is known.
    """
    reader = _find_reader(path)
    if ending_of(path) in _MAY_LACK_VALUES:
        motion, missing = reader.read(examples.resolve(path), lossy=True)
        return _finish(motion, path, metres_per_unit), missing
    from mapctl.formats.missing import MissingValues

    motion = load(path, metres_per_unit=metres_per_unit)
    return motion, MissingValues.none(motion.num_frames, motion.num_joints)


def _finish(motion: "Motion", path: str | PathLike[str], metres_per_unit: float | None) -> "Motion":
    """Convert the unit where one is given; mark examples with their licence, which BVH has no place for."""
    motion = replace(motion, licence=examples.LICENCE) if examples.is_example(path) else motion
    if metres_per_unit is None:
        return motion
    from mapctl.formats.bvh import convert_unit

    return convert_unit(motion, metres_per_unit)


def _find_reader(path: str | PathLike[str]) -> ModuleType:
    """Import the module for an ending; FileFormatError where there is none, or its package is not installed."""
    ending = ending_of(path)
    if ending not in READERS:
        asf = "is a skeleton alone: name its motion, a .amc beside it or subject.asf+take.amc"
        why = asf if ending == ".asf" else f"cannot read the ending {ending!r}"
        raise FileFormatError(path, f"{why}; allowed: {', '.join(READERS)}")
    try:
        return import_module(f"mapctl.formats.{READERS[ending]}")
    except ModuleNotFoundError as error:
        if error.name not in _NEEDED:
            raise
        raise FileFormatError(path, _NEEDED[error.name]) from None


def save(motion: "Motion", path: str | PathLike[str]) -> None:
    """Write a motion in a format of `WRITERS`, whole or not at all. RequestError if it cannot be written there."""
    check_ending(path)
    import_module(f"mapctl.formats.{WRITERS[Path(path).suffix.lower()]}").save(motion, path)


def check_ending(path: str | PathLike[str]) -> None:
    """Raise RequestError unless `path` ends as a format that can be written, and is installed; to fail before long
    work."""
    ending = Path(path).suffix.lower()
    if ending not in WRITERS:
        why = f"{ending} is read but not written" if ending in _ONLY_READ else f"unknown ending {ending!r}"
        raise RequestError(f"cannot write {path}: {why}; allowed: {', '.join(WRITERS)}")
    if ending in USD_WRITTEN and find_spec("pxr") is None:
        raise RequestError(f"cannot write {path}: {_NEEDED['pxr']}")
