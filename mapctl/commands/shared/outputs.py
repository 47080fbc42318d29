"""Checks of output files and folders before any long work, so that a typing error does not cost an hour."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib.util import find_spec
from os import PathLike
from pathlib import Path
from typing import Any

from mapctl import formats
from mapctl.errors import RequestError
from mapctl.formats import atomic
from mapctl.motion import Motion
from priors import licences


def check_files(paths: Sequence[Path], *, given: Sequence[Path] = ()) -> None:
    """Raise RequestError unless all files can be written, none twice and none over a given one; leaves no trace."""
    known: set[str] = set()
    sources = {os.path.realpath(path) for path in given}
    for path in paths:
        atomic.check_writable(path)
        real = os.path.realpath(path)
        if real in sources:
            raise RequestError(f"{path} would be written over what it is made from; choose another name")
        if real in known:
            raise RequestError(f"{path} is asked for twice; every output needs a file of its own")
        known.add(real)


def check_film(path: Path, size: tuple[int, int]) -> None:
    """Raise RequestError where a film of this ending or size cannot be made, or its package is missing."""
    from scenes.film import check_outputs

    check_outputs([path], size)
    require_render("av" if path.suffix.lower() == ".mp4" else "PIL")


def check_picture(path: Path | None, *, given: Path) -> None:
    """Raise RequestError where a requested picture cannot be made of a given file, or would be written over it."""
    if path is None:
        return
    if path.suffix.lower() != ".png":
        raise RequestError(f"--out writes .png, not {path.suffix or 'a file without ending'}")
    require_render("matplotlib")
    check_files([path], given=[given])


def require_render(package: str) -> None:
    """Raise RequestError that names the extra if a package of it is not installed."""
    if find_spec(package) is None:
        raise RequestError(describe_missing_render([package]))


def find_missing_render(ending: str) -> list[str]:
    """Find the packages that are not installed of those without which there is no film of this ending, as `png`."""
    painter = "matplotlib" if find_spec("pyrender") is None else "pyrender"
    wanted = [*(["av"] if ending == "mp4" else []), "PIL", painter]
    return [package for package in wanted if find_spec(package) is None]


def describe_missing_render(packages: Sequence[str]) -> str:
    """Say which packages films need, and which extra has them."""
    noun = "the package" if len(packages) == 1 else "the packages"
    return f"films need {noun} {', '.join(packages)}: pip install 'mapctl[render]'"


def check_folder(folder: str | PathLike[str]) -> None:
    """Raise RequestError unless the folder exists and is writable, or can be made; leaves no trace."""
    atomic.check_folder(folder)


@contextmanager
def make_folder(folder: Path) -> Iterator[Path]:
    """Make a folder with its parents; those made here are removed again if the work leaves them empty."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    finally:
        for path in missing:
            with suppress(OSError):
                path.rmdir()


def add_licence(report: Mapping[str, Any]) -> dict[str, Any]:
    """Add to a report the licences of the models that were used, the strictest first."""
    return {**report, **licences.describe_licences(licences.find_used_licences())}


def format_used_licences() -> str:
    """Format the licences of what was used so far for a file: without the folders of models and motions."""
    return licences.format_licences(licences.shorten_names(licences.find_used_licences()))


def mark_motion(motion: Motion) -> Motion:
    """Mark a motion with the licences of what was used so far, where anything was."""
    told = format_used_licences()
    return replace(motion, licence=told) if told else motion


def save_motion(motion: Motion, path: Path) -> None:
    """Write a motion with the licences of what it was made with, in formats that keep them."""
    formats.save(mark_motion(motion), path)
