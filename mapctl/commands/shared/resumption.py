"""What there is of work that ended early, and how it goes on, in one line."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mapctl.errors import WriteError


@contextmanager
def explain_end(describe: Callable[[], str]) -> Iterator[None]:
    """What Ctrl-C, SIGTERM or a full disk ends within says what `describe` then finds saved, and what to type."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(describe() or "nothing was saved yet") from stop
    except WriteError as error:
        raise WriteError(_join_sentences(str(error), describe())) from error


@contextmanager
def explain_progress(count: int, what: str, then: str = "") -> Iterator[Callable[[int], None]]:
    """Yield a function that takes how many are finished; Ctrl-C, SIGTERM and a full disk say it, and what to do
    `then`.
    """
    finished = 0

    def tell(number: int) -> None:
        nonlocal finished
        finished = number

    def kept() -> tuple[str, ...]:
        return (f"{finished} of {count} {what} are finished", then) if finished else ()

    try:
        yield tell
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(_join_sentences(str(stop), *kept())) from stop
    except WriteError as error:
        raise WriteError(_join_sentences(str(error), *kept())) from error


def _join_sentences(*parts: str) -> str:
    return "; ".join(filter(None, parts))
