"""Progress of long work: a bar on a terminal, lines for a program that asks for them, else nothing in a pipe."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mapctl.errors import WriteError
from mapctl.runtime.progress import Progress

LINES = "MAPCTL_PROGRESS"
"""Environment variable that asks for lines `progress DONE/TOTAL LABEL` on standard error."""


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
    from rich import progress
    from rich.console import Console

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeRemainingColumn(),
    )
    with progress.Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task(label, total=None)
        yield lambda done, total: shown.update(task, completed=done, total=total)


def _write_lines(label: str) -> Progress:
    last = -1

    def write(done: int, total: int) -> None:
        nonlocal last
        hundredth = 100 * done // max(total, 1)
        if hundredth != last:
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

    def kept() -> tuple[str, ...]:
        return (f"{finished} of {count} {what} are finished", then) if finished else ()

    try:
        yield set_finished
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(_join_sentences(str(stop), *kept())) from stop
    except WriteError as error:
        raise WriteError(_join_sentences(str(error), *kept())) from error


def _join_sentences(*parts: str) -> str:
    return "; ".join(filter(None, parts))
