"""Where results go: checked before any long work, so that a typing error does not cost an hour."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from os import PathLike
from pathlib import Path

from mapctl.errors import RequestError
from mapctl.formats import atomic
from scenes.film import check_outputs


def check_files(paths: Sequence[Path], *, given: Sequence[Path] = ()) -> None:
    """RequestError unless every file can be written, no two are the same and none is a given one; leaves no trace."""
    seen: set[str] = set()
    sources = {os.path.realpath(path) for path in given}
    for path in paths:
        atomic.check_writable(path)
        real = os.path.realpath(path)
        if real in sources:
            raise RequestError(f"{path} would be written over what it is made from; choose another name")
        if real in seen:
            raise RequestError(f"{path} is asked for twice; every output needs a file of its own")
        seen.add(real)


def check_film(path: Path, size: tuple[int, int]) -> None:
    """RequestError where a film of this ending or size cannot be made, or its package is missing."""
    check_outputs([path], size)
    require_render("av" if path.suffix.lower() == ".mp4" else "PIL")


def check_plot(path: Path | None) -> None:
    """RequestError where a --plot that is asked for cannot be made: another ending than .png, or no matplotlib."""
    if path is None:
        return
    if path.suffix.lower() != ".png":
        raise RequestError(f"--plot writes .png, not {path.suffix or 'a file without ending'}")
    require_render("matplotlib")


def require_render(package: str) -> None:
    """RequestError that names the extra if a package of it is not installed."""
    if find_spec(package) is None:
        raise RequestError(f"films need the package {package}: pip install 'mapctl[render]'")


def check_folder(folder: str | PathLike[str]) -> None:
    """RequestError unless the folder is there and can be written in, or can be made; leaves no trace."""
    atomic.check_folder(folder)


@contextmanager
def make_folder(folder: Path) -> Iterator[Path]:
    """The folder, made with its parents; those made here are removed again if the work leaves them empty."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    finally:
        for place in missing:
            with suppress(OSError):
                place.rmdir()
