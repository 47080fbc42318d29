"""Outputs of commands: checks of files before any long work, tables on standard output, and progress.

Progress is a bar on a terminal, lines for a program that requests them, and nothing in a pipe.
"""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table

from mapctl import formats
from mapctl.errors import RequestError, WriteError
from mapctl.formats.atomic import check_folder as check_folder
from mapctl.formats.atomic import check_writable
from mapctl.motion import Motion
from mapctl.runtime.stepwise import Progress
from priors import weight_sets


def check_files(paths: Sequence[Path], *, given: Sequence[Path] = ()) -> None:
    """Raise RequestError unless all files can be written, none twice and none over a given one; leaves no trace."""
    known: set[str] = set()
    sources = {os.path.realpath(path) for path in given}
    for path in paths:
        check_writable(path)
        real = os.path.realpath(path)
        if real in sources:
            raise RequestError(f"{path} would overwrite its own source; choose another name")
        if real in known:
            raise RequestError(f"{path} is requested twice; every output needs a file of its own")
        known.add(real)


def number_path(path: Path, number: int) -> Path:
    """Number the path of a variation: walk_000.bvh, walk_001.bvh, ... for walk.bvh."""
    return path.with_name(f"{path.stem}_{number:03d}{path.suffix}")


FILM_SIZE = (1280, 720)
"""Width and height of films whose size is not requested, pixels."""


def check_film(path: Path, size: tuple[int, int]) -> None:
    """Raise RequestError where a film of this ending or size cannot be made, or its package is missing."""
    from scenes.film import check_outputs

    check_outputs([path], size)
    require_render("av" if path.suffix.lower() == ".mp4" else "PIL")


def require_render(*packages: str) -> None:
    """Raise RequestError that names the extra if a package of it is not installed."""
    if missing := [package for package in packages if find_spec(package) is None]:
        noun = "the package" if len(missing) == 1 else "the packages"
        raise RequestError(f"films need {noun} {', '.join(missing)}: pip install 'mapctl[render]'")


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
    return {**report, **weight_sets.describe_licences(weight_sets.find_used_licences())}


def format_used_licences() -> str:
    """Format the licences of what was used so far for a file: without the folders of models and motions."""
    return weight_sets.format_licences(weight_sets.shorten_names(weight_sets.find_used_licences()))


def mark_motion(motion: Motion) -> Motion:
    """Mark a motion with the licences of what was used so far, where anything was."""
    return replace(motion, licence=format_used_licences() or motion.licence)


def save_motion(motion: Motion, path: Path) -> None:
    """Write a motion with the licences of the models used, in formats that keep them."""
    formats.save(mark_motion(motion), path)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[object]], *, title: str | None = None) -> None:
    """Numbers to the right with four digits, the rest as text; None and NaN as a dash."""
    console = Console(width=None if Console().is_terminal else 200, highlight=False)
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for number, column in enumerate(columns):
        numeric = any(isinstance(row[number], int | float) for row in rows)
        table.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        table.add_row(*(format_cell(value) for value in row))
    console.print(table)


def format_cell(value: object) -> str:
    """One value as a table shows it."""
    if value is None or value != value:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


LINES = "MAPCTL_PROGRESS"
"""Environment variable that requests lines `progress DONE/TOTAL LABEL` on standard error."""


@contextmanager
def show_progress(label: str, *, quiet: bool = False) -> Iterator[Progress | None]:
    """Yield a function that moves a bar on standard error; None where there is no terminal, or with `quiet`. Where the
    environment variable MAPCTL_PROGRESS is set to something, it writes a line for each hundredth instead.
    """
    if os.environ.get(LINES):
        yield _write_lines(label)
        return
    if quiet or not sys.stderr.isatty():
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with ProgressBar(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(label, total=None)
        yield lambda done, total: shown.update(task, completed=done, total=total)


def _write_lines(label: str) -> Progress:
    last = -1

    def write(done: int, total: int) -> None:
        nonlocal last
        if (hundredth := 100 * done // max(total, 1)) != last:
            last = hundredth
            print(f"progress {done}/{total} {label}", file=sys.stderr, flush=True)

    return write


@contextmanager
def explain_progress(count: int, what: str, then: str = "") -> Iterator[Callable[[int], None]]:
    """Yield a function that takes the number of finished items; add it to the message of Ctrl-C, SIGTERM or a full disk
    within, and what to do `then`.
    """
    finished = 0

    def set_finished(number: int) -> None:
        nonlocal finished
        finished = number

    try:
        yield set_finished
    except (KeyboardInterrupt, WriteError) as stop:
        kept = (f"{finished} of {count} {what} are finished", then) if finished else ()
        raise type(stop)("; ".join(filter(None, (str(stop), *kept)))) from stop
