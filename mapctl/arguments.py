"""Arguments of callers: numbers and points of Python, numpy or torch, finite, and of the right shape."""

import math
from collections.abc import Iterable
from typing import Any

from mapctl.errors import RequestError

_SHOWN_LENGTH = 40  # characters of a wrong value that a message repeats
_WORDS = {2: "two", 3: "three"}


def read_number(value: Any, what: str) -> float:
    """Return a finite number; RequestError, which begins with `what` it is for, for anything else, text too."""
    try:
        found = math.nan if isinstance(value, str | bytes) else float(value)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):  # the last from a tensor of several numbers
        found = math.nan
    if not math.isfinite(found):
        raise RequestError(f"{what} must be a finite number, got {_shorten(value)}")
    return found


def read_point(values: Any, size: int, what: str) -> tuple[float, ...]:
    """Return a point of `size` finite numbers; RequestError, which begins with `what` it is for, for anything else."""
    try:
        found = tuple(read_number(value, what) for value in values)
    except (TypeError, RequestError):  # the first from what holds nothing
        found = ()
    if len(found) != size:
        raise RequestError(f"{what} must be {_WORDS[size]} finite numbers of metres, got {_shorten(values)}")
    return found


def read_names(values: Any, what: str) -> tuple[str, ...]:
    """Return names; RequestError, which begins with `what` they are, for anything else, and for a single text, whose
    letters would be taken for names."""
    if isinstance(values, Iterable) and not isinstance(values, str):
        found = tuple(values)
        if all(isinstance(name, str) for name in found):
            return tuple(map(str, found))
    raise RequestError(f"{what} must be a sequence of names, got {_shorten(values)}")


def _shorten(value: object) -> str:
    return " ".join(repr(value).split())[:_SHOWN_LENGTH]
