"""What there is of work that ended early, and how it goes on, in one line."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace

from mapctl.commands.train import Train
from mapctl.errors import WriteError
from priors.training.run_files import read_last_step


@contextmanager
def explain_resumption(given: Train) -> Iterator[None]:
    """What Ctrl-C, SIGTERM or a full disk ends within says what is saved, and what to type."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(_describe_resumption(given) or "nothing was saved yet") from stop
    except WriteError as error:
        raise WriteError(_join_sentences(str(error), _describe_resumption(given))) from error


@contextmanager
def explain_progress(count: int, what: str, then: str = "") -> Iterator[Callable[[int], None]]:
    """Yield a function that is told how many are finished; Ctrl-C, SIGTERM and a full disk say it, and what to do
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


def format_command(given: Train) -> list[str]:
    """What to type for a command; options that are the defaults are left out."""
    typed = ["mapctl", "train", given.model]
    for option in fields(given):
        value, name = getattr(given, option.name), f"--{option.name.replace('_', '-')}"
        if option.name == "model" or value == option.default:
            continue
        if value is True:
            typed.append(name)
        elif str(value).startswith("-"):
            typed.append(f"{name}={value}")
        else:
            typed += [name, str(value)]
    return typed


def _join_sentences(*parts: str) -> str:
    return "; ".join(filter(None, parts))


def _describe_resumption(given: Train) -> str:
    """Empty where the run folder holds no checkpoint."""
    step = read_last_step(given.out)
    typed = shlex.join([*format_command(replace(given, resume=False)), "--resume"])
    return "" if step is None else f"step {step} is saved; go on with: {typed}"
