"""Orders that programs send over OSC: `/mapctl/NAME` for the first character, `/mapctl/2/NAME` for the second.

Syntax alone: names of orders, and how many numbers or words each takes. Their meaning and the limits of their numbers
are in `scenes.live.remote`.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from mapctl.errors import RequestError
from mapctl.streaming.messages import Message


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


_ADDRESS = re.compile(r"/mapctl(?:/(?P<character>\d{1,4}))?/(?P<name>[a-z][a-z_/]{0,30})")
_SHOWN_LENGTH = 40  # characters of what a program sent that a message repeats
_MAX_PATH_POINTS = 200

HANDS = {"hand/left": "left", "hand/right": "right"}
"""Names of the orders that a hand obeys."""
NUMBERS: Mapping[str, Sequence[int]] = {
    "speed": (1,),
    "heading": (1,),
    "facing": (0, 1),
    "step_length": (0, 1),
    "stop": (0,),
    **dict.fromkeys(HANDS, (0, 3)),
    "look": (0, 3),
    "goto": (2, 3, 4),
    "path": range(4, 2 * _MAX_PATH_POINTS + 1, 2),
    "disc": (0, 3),
    "pause": (0, 1),
    "reset": (0,),
}
"""Counts of numbers that each order takes; an order without its optional numbers cancels the earlier one."""


@dataclass(frozen=True)
class Order:
    """One order."""

    character: int
    """Index of the character, from 0."""
    name: str
    """Name of the order, as `speed` or `hand/left`, or a group of labels, as `style`."""
    numbers: tuple[float, ...] = ()
    """Its numbers, finite."""
    word: str | None = None
    """Its label, if it is about a group of labels."""


def read_order(message: Message, *, characters: int, groups: Iterable[str]) -> Order:
    """Read an order for one of so many characters. RequestError names its fault.

    `groups` are the groups of labels that there are, as `gait` and `style`; each is an order that takes a word.
    """
    found, shown = _ADDRESS.fullmatch(message.address), _shorten(message.address)
    name = "" if found is None else found["name"]
    if found is None or (name not in NUMBERS and name not in groups):
        raise RequestError(f"{shown} is no order; there are /mapctl/ and {', '.join([*NUMBERS, *groups])}")
    number = int(found["character"] or 1)
    if not 1 <= number <= characters:
        raise RequestError(f"{shown}: there is no character {number}")
    if name in groups:
        return Order(number - 1, name, word=_read_word(shown, message.arguments))
    return Order(number - 1, name, _read_numbers(shown, NUMBERS[name], message.arguments))


def keep_latest(orders: Iterable[Order]) -> list[Order]:
    """Return of each character and name the last order, in the order in which those came."""
    found: dict[tuple[int, str], Order] = {}
    for order in orders:
        found.pop((order.character, order.name), None)
        found[order.character, order.name] = order
    return list(found.values())


def _read_word(shown: str, arguments: Sequence[object]) -> str:
    if len(arguments) != 1 or not isinstance(arguments[0], str):
        raise RequestError(f"{shown} takes one word")
    return arguments[0]


def _read_numbers(shown: str, counts: Sequence[int], arguments: Sequence[object]) -> tuple[float, ...]:
    if len(arguments) not in counts:
        raise RequestError(f"{shown} takes {_describe_counts(counts)}, not {len(arguments)}")
    found = tuple(float(value) for value in arguments if is_number(value))  # pyright: ignore[reportArgumentType]
    if len(found) < len(arguments):
        raise RequestError(f"{shown} takes finite numbers, not {_shorten(arguments)}")
    return found


def _describe_counts(counts: Sequence[int]) -> str:
    if isinstance(counts, range):
        return f"x and z of {counts.start // 2} to {counts[-1] // 2} points"
    words = " or ".join("no" if count == 0 else str(count) for count in counts)
    return f"{words} number{'' if counts[-1] == 1 else 's'}"


def _shorten(value: object) -> str:
    text = " ".join(str(value).split())
    return ascii(text[:_SHOWN_LENGTH])[1:-1][:_SHOWN_LENGTH]
