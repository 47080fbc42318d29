"""Commands of other programs over OSC, obeyed by live characters: `/mapctl/NAME` is for the first, `/mapctl/2/NAME` for
the second.
"""

import math
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mapctl.errors import MapctlError, RequestError
from mapctl.streaming.messages import Message, is_number
from scenes.live.character import ShownCharacter
from scenes.live.inputs import read_degrees, read_position

if TYPE_CHECKING:  # python-osc may not be installed
    from mapctl.streaming.receiver import OscReceiver
    from scenes.live.app import LiveApp

_DEFAULT_WITHIN = 2.0  # seconds in which a character is sent to a position, unless the command has a time
_REPORT_SECONDS = 2.0  # between two lines on the console, however many commands there are
_ADDRESS = re.compile(r"/mapctl(?:/(?P<character>\d{1,4}))?/(?P<name>[a-z][a-z_/]{0,30})")
_SHOWN_LENGTH = 40  # characters of what a program sent that a message repeats

_HANDS = {"hand/left": "leftHand", "hand/right": "rightHand"}  # orders that a hand obeys
_NUMBERS: Mapping[str, Sequence[int]] = {
    "speed": (1,),
    "heading": (1,),
    "facing": (0, 1),
    **dict.fromkeys(_HANDS, (0, 3)),
    "look": (0, 3),
    "goto": (2, 3, 4),
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
    arguments: tuple[Any, ...] = ()
    """Its numbers, finite; the label of an order about a group of labels."""


def read_order(message: Message, *, characters: int, groups: Iterable[str]) -> Order:
    """Read an order for one of so many characters. RequestError names its fault.

    `groups` are the groups of labels that there are, as `gait` and `style`; each is an order that takes a word.
    """
    found, shown = _ADDRESS.fullmatch(message.address), _shorten(message.address)
    name = "" if found is None else found["name"]
    if found is None or (name not in _NUMBERS and name not in groups):
        raise RequestError(f"{shown} is no order; there are /mapctl/ and {', '.join([*_NUMBERS, *groups])}")
    number = int(found["character"] or 1)
    if not 1 <= number <= characters:
        raise RequestError(f"{shown}: there is no character {number}")
    given = message.arguments
    if name in groups:
        if len(given) != 1 or not isinstance(given[0], str):
            raise RequestError(f"{shown} takes one word")
        return Order(number - 1, name, given)
    counts = _NUMBERS[name]
    if len(given) not in counts:
        words = " or ".join("no" if count == 0 else str(count) for count in counts)
        raise RequestError(f"{shown} takes {words} number{'' if counts[-1] == 1 else 's'}, not {len(given)}")
    if not all(map(is_number, given)):
        raise RequestError(f"{shown} takes finite numbers, not {_shorten(given)}")
    return Order(number - 1, name, given)


def keep_latest(orders: Iterable[Order]) -> list[Order]:
    """Return of each character and name the last order, in the order in which those came."""
    found: dict[tuple[int, str], Order] = {}
    for order in orders:
        found.pop((order.character, order.name), None)
        found[order.character, order.name] = order
    return list(found.values())


def _shorten(value: object) -> str:
    text = " ".join(str(value).split())
    return ascii(text[:_SHOWN_LENGTH])[1:-1][:_SHOWN_LENGTH]


class RemoteCommands:
    """Reads what other programs send, and has it obeyed: of several commands of a kind the last that came."""

    def __init__(self, source: "OscReceiver", app: "LiveApp"):
        self._source, self._app = source, app
        self._noted_at, self._dropped = -math.inf, 0

    def obey(self) -> None:
        """Obey what came since the last call; one line in two seconds names what could not be obeyed."""
        found, notes, characters = list[Order](), list[str](), self._app.characters
        for message in self._source.poll():
            try:
                found.append(read_order(message, characters=len(characters), groups=self._app.labels))
            except RequestError as error:
                notes.append(str(error))
        # What steers comes first, then where to go, which keeps the new speed.
        for order in sorted(keep_latest(found), key=lambda order: order.name == "goto"):
            try:
                notes += self._act(characters[order.character], order)
            except MapctlError as error:
                notes.append(str(error))
        dropped = self._source.dropped - self._dropped
        notes += [self._source.fault] if dropped else []
        now = time.perf_counter()
        if notes and now - self._noted_at >= _REPORT_SECONDS:
            self._noted_at, self._dropped = now, self._source.dropped
            self._app.print(f"OSC: {notes[-1]}{f' (and {len(notes) - 1} more)' if len(notes) > 1 else ''}")

    def _act(self, character: ShownCharacter, order: Order) -> list[str]:
        """Do what one order asks for; return what could not be done as it was asked."""
        app, numbers = self._app, order.arguments
        match order.name:
            case "reset":
                app.restart()
            case "pause":
                app.set_paused(numbers != (0,))
            case "goto":
                x, _, z = read_position((numbers[0], 0.0, numbers[1]))
                within = numbers[2] if len(numbers) > 2 else _DEFAULT_WITHIN
                app.targets.go(character, (x, z), within, read_degrees(numbers[3]) if len(numbers) > 3 else None)
            case "look":
                app.aim(character, look_at=read_position(numbers) if numbers else None)
            case "hand/left" | "hand/right":
                others = {hand: at for hand, at in character.wanted.reach.items() if hand != _HANDS[order.name]}
                app.aim(character, reach=others | ({_HANDS[order.name]: read_position(numbers)} if numbers else {}))
            case "speed":
                return app.change(character, speed=float(numbers[0]))
            case "heading" | "facing":
                return app.change(character, **{order.name: read_degrees(numbers[0]) if numbers else None})
            case group:
                app.label(character, group, *numbers)
        return []
