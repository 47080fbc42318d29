"""Commands of other programs over OSC, obeyed by live characters: `/mapctl/NAME` is for the first, `/mapctl/2/NAME` for
the second.
"""

import math
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError, RequestError
from mapctl.streaming.messages import Message, is_number
from scenes.live.character import ShownCharacter
from scenes.live.inputs import DISC_RADII, WITHIN, parse_point

if TYPE_CHECKING:  # python-osc may not be installed
    from mapctl.streaming.receiver import OscReceiver
    from scenes.live.app import LiveApp

_DEFAULT_WITHIN = 2.0  # seconds in which a character is sent to a position, unless the command has a time
_REPORT_SECONDS = 2.0  # between two lines on the console, however many commands there are
_ADDRESS = re.compile(r"/mapctl(?:/(?P<character>\d{1,4}))?/(?P<name>[a-z][a-z_/]{0,30})")
_SHOWN_LENGTH = 40  # characters of what a program sent that a message repeats
_MAX_PATH_POINTS = 200

_HANDS = {"hand/left": "left", "hand/right": "right"}  # orders that a hand obeys
_NUMBERS: Mapping[str, Sequence[int]] = {
    "speed": (1,),
    "heading": (1,),
    "facing": (0, 1),
    "step_length": (0, 1),
    "stop": (0,),
    **dict.fromkeys(_HANDS, (0, 3)),
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
    if found is None or (name not in _NUMBERS and name not in groups):
        raise RequestError(f"{shown} is no order; there are /mapctl/ and {', '.join([*_NUMBERS, *groups])}")
    number = int(found["character"] or 1)
    if not 1 <= number <= characters:
        raise RequestError(f"{shown}: there is no character {number}")
    if name in groups:
        return Order(number - 1, name, word=_read_word(shown, message.arguments))
    return Order(number - 1, name, _read_numbers(shown, _NUMBERS[name], message.arguments))


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
                found.append(read_order(message, characters=len(characters), groups=list(self._app.limits.labels)))
            except RequestError as error:
                notes.append(str(error))
        # What steers comes first, then where to go, which keeps the new speed.
        for order in sorted(keep_latest(found), key=lambda order: order.name in ("goto", "path")):
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
        app, numbers = self._app, order.numbers
        first = numbers[0] if numbers else None
        match order.name:
            case "reset":
                app.restart()
            case "pause":
                app.set_paused(first != 0)
            case "disc":
                app.set_disc(_read_disc(numbers))
            case "path":
                app.walk(character, _read_points(numbers))
            case "goto":
                asked = numbers[2] if len(numbers) > 2 else _DEFAULT_WITHIN
                facing = math.radians(math.remainder(numbers[3], 360)) if len(numbers) > 3 else None
                within = min(WITHIN[1], max(WITHIN[0], asked))
                app.targets.go(character, _read_points(numbers[:2])[0], within, facing)
            case "look":
                app.aim(character, look_at=_read_position(order))
            case "hand/left" | "hand/right":
                reach = {**character.inputs.reach, _HANDS[order.name]: _read_position(order)}
                app.aim(character, reach={hand: point for hand, point in reach.items() if point is not None})
            case "stop":
                return app.change(character, {"speed": 0.0})
            case name if order.word is not None:
                return app.change(character, {"labels": {name: order.word}})
            case name:
                return app.change(character, {name: first})
        return []


def _read_position(order: Order) -> Any:
    """Return a position in the world, metres; None without one."""
    point = parse_point(order.numbers) if order.numbers else None
    if order.numbers and point is None:
        raise RequestError(f"{order.name}: the position is too far away")
    return point


def _read_points(numbers: Sequence[float]) -> list[tuple[float, float]]:
    points = list(zip(numbers[::2], numbers[1::2], strict=True))
    if any(parse_point((x, 0.0, z)) is None for x, z in points):
        raise RequestError("the position is too far away")
    return points


def _read_disc(numbers: Sequence[float]) -> Obstacle | None:
    if not numbers:
        return None
    x, z, radius = numbers
    if not DISC_RADII[0] <= radius <= DISC_RADII[1] or parse_point((x, 0.0, z)) is None:
        raise RequestError(f"disc: the radius must be {DISC_RADII[0]:g} to {DISC_RADII[1]:g} m, the position near")
    return Obstacle((x, z), radius)
