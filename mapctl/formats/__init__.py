"""Reading and writing motions in file formats, chosen by the ending; each module owns its format's quirks."""

from collections.abc import Callable
from fractions import Fraction
from os import PathLike
from pathlib import PurePath

from mapctl.errors import FileFormatError, RequestError
from mapctl.formats import acclaim, bvh, npz, usd
from mapctl.formats.missing import MissingValues
from mapctl.motion import Motion


def _save_glb(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a .glb; its module is imported late, since it draws a body, which the other formats need not load."""
    from mapctl.formats import gltf

    gltf.save(motion, path)


READERS: dict[str, Callable[[str | PathLike[str]], Motion]] = {".bvh": bvh.load, ".npz": npz.load, ".amc": acclaim.load}
_READERS_WITH_MISSING: dict[str, Callable[[str | PathLike[str]], tuple[Motion, MissingValues]]] = {
    ".bvh": bvh.load_with_missing,
    ".npz": npz.load_lossy,
    ".amc": acclaim.load_with_missing,
}
WRITERS: dict[str, Callable[[Motion, str | PathLike[str]], None]] = {
    ".bvh": bvh.save,
    ".npz": npz.save,
    ".glb": _save_glb,
    **dict.fromkeys(usd.ENDINGS, usd.save),
}
_UNREADABLE_REASONS = {
    ".asf": "is a skeleton alone: name its motion, a .amc beside it or subject.asf+take.amc",
    ".glb": "can be written but not read",
    **dict.fromkeys(usd.ENDINGS, "can be written but not read"),
}


def load(
    path: str | PathLike[str], *, fps: Fraction | float | None = None, metres_per_unit: float | None = None
) -> Motion:
    """Read a motion from a .bvh, .npz or .amc file, the last with the .asf beside it (see `acclaim.load`).

    `fps` is frames per second of an .amc, which does not say; RequestError with the others, which do. `metres_per_unit`
    wins over what is found by the size of the body, in formats whose unit is not fixed. FileFormatError says what is
    wrong with the file, and where: NaN in place of a number, too, which `load_with_missing` takes.
    """
    ending = _check_readable(path)
    if fps is not None and ending != ".amc":
        raise RequestError(f"{path}: a {ending} file says its frame rate itself; only that of an .amc is asked for")
    motion = READERS[ending](path) if fps is None else acclaim.load(path, fps=fps)
    return motion if metres_per_unit is None else bvh.convert_unit(motion, metres_per_unit)


def load_with_missing(
    path: str | PathLike[str], *, metres_per_unit: float | None = None
) -> tuple[Motion, MissingValues]:
    """Read a motion as `load` does, from a file that may have NaN for missing values; also return where they are.

    The motion is finite: missing rotations repeat the last known one, missing positions are interpolated linearly.
    FileFormatError where nothing is known.
    """
    motion, missing = _READERS_WITH_MISSING[_check_readable(path)](path)
    return motion if metres_per_unit is None else bvh.convert_unit(motion, metres_per_unit), missing


def _check_readable(path: str | PathLike[str]) -> str:
    """Return the ending; FileFormatError unless it is one of `READERS`."""
    ending = PurePath(path).suffix.lower()
    if ending not in READERS:
        why = _UNREADABLE_REASONS.get(ending, f"cannot read the ending {ending!r}")
        raise FileFormatError(path, f"{why}; allowed: {', '.join(READERS)}")
    return ending


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion in a format of `WRITERS`, whole or not at all. RequestError if it cannot be written there."""
    check_ending(path)
    WRITERS[PurePath(path).suffix.lower()](motion, path)


def check_ending(path: str | PathLike[str]) -> None:
    """Raise RequestError unless `path` ends as a format that can be written, and is installed; to fail before long
    work."""
    ending = PurePath(path).suffix.lower()
    if ending not in WRITERS:
        raise RequestError(f"cannot write {path}: unknown ending {ending!r}; allowed: {', '.join(WRITERS)}")
    if ending in usd.ENDINGS:
        usd.check_installed(path)
