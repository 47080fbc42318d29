"""Messages on work that ended early: what is saved, and how to resume."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mapctl.errors import WriteError


@contextmanager
def explain_end(describe: Callable[[], str]) -> Iterator[None]:
    """Add to the message of Ctrl-C, SIGTERM or a full disk within what `describe` finds saved, and what to type."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(describe() or "nothing was saved yet") from stop
    except WriteError as error:
        raise WriteError(_join_sentences(str(error), describe())) from error


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
