"""How a training run that ended early goes on: one line that can be typed."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import TYPE_CHECKING

from mapctl.errors import WriteError

if TYPE_CHECKING:
    from mapctl.commands.train import Train


@contextmanager
def telling_how_to_go_on(given: "Train") -> Iterator[None]:
    """What Ctrl-C, SIGTERM or a full disk ends within says what is saved, and what to type."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(_how(given) or "nothing was saved yet") from stop
    except WriteError as error:
        raise WriteError("; ".join(filter(None, (str(error), _how(given))))) from error


def words(given: "Train") -> list[str]:
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


def _how(given: "Train") -> str:
    """Empty where the run folder holds no checkpoint."""
    from priors.training.run_files import last_step

    step = last_step(given.out)
    typed = shlex.join([*words(replace(given, resume=False)), "--resume"])
    return "" if step is None else f"step {step} is saved; go on with: {typed}"
