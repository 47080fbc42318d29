"""Files to Motion and back. Each module owns its format's quirks; this one only picks by ending."""

from collections.abc import Callable
from os import PathLike
from pathlib import PurePath

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import bvh, npz
from mapctl.motion import Motion


def _save_glb(motion: Motion, path: str | PathLike[str]) -> None:
    from mapctl.formats import gltf  # late: it draws a body, which the other formats need not load

    gltf.save(motion, path)


READERS: dict[str, Callable[[str | PathLike[str]], Motion]] = {".bvh": bvh.load, ".npz": npz.load}
WRITERS: dict[str, Callable[[Motion, str | PathLike[str]], None]] = {
    ".bvh": bvh.save, ".npz": npz.save, ".glb": _save_glb,
}  # fmt: skip


def load(path: str | PathLike[str], *, metres_per_unit: float | None = None) -> Motion:
    """Read a motion from a .bvh or .npz file. FileFormatError says what is wrong with the file, and where.

    `metres_per_unit` wins over what is found by the size of the body, in formats whose unit is not fixed.
    """
    ending = PurePath(path).suffix.lower()
    if ending not in READERS:
        raise FileFormatError(path, f"cannot read the ending {ending!r}; allowed: {', '.join(READERS)}")
    motion = READERS[ending](path)
    return motion if metres_per_unit is None else bvh.in_unit(motion, metres_per_unit)


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion as .bvh, .npz or .glb, whole or not at all. RequestError if it cannot be written there."""
    check_ending(path)
    WRITERS[PurePath(path).suffix.lower()](motion, path)


def check_ending(path: str | PathLike[str]) -> None:
    """RequestError unless `path` ends as a format that can be written; to fail before long work."""
    ending = PurePath(path).suffix.lower()
    if ending not in WRITERS:
        raise RequestError(f"cannot write {path}: unknown ending {ending!r}; allowed: {', '.join(WRITERS)}")
