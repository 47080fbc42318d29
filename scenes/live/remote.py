"""Commands that other programs send over OSC, obeyed as those of the page are, within the same limits."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError, RequestError
from mapctl.streaming.orders import HANDS, Order, keep_latest, read_order
from scenes.live.character import ShownCharacter
from scenes.live.inputs import DISC_RADII, WITHIN, parse_point

if TYPE_CHECKING:
    from mapctl.streaming.receiver import OscReceiver
    from scenes.live.app import LiveApp

_DEFAULT_WITHIN = 2.0  # seconds in which a character is sent to a position, unless the command has a time
_NOTE_SECONDS = 2.0  # between two lines on the console, however many commands there are


class RemoteCommands:
    """Reads what other programs send, and has it obeyed: of several commands of a kind the last that came."""

    def __init__(self, source: "OscReceiver", app: "LiveApp", notify: Callable[[str], None]):
        """`notify` prints a line."""
        self._source, self._app, self._notify = source, app, notify
        self._noted_at, self._dropped = -math.inf, 0

    def obey(self) -> None:
        """Obey what came since the last call."""
        notes = list[str]()
        for character, orders in self._read(notes):
            changes: dict[str, Any] = {}
            for order in orders:
                try:
                    if order.name in HANDS or order.name == "look":
                        self._aim(character, order)
                    elif (act := self._actions().get(order.name)) is not None:
                        act(character, order)
                    elif order.word is not None:
                        changes["labels"] = {**changes.get("labels", {}), order.name: order.word}
                    elif order.name == "stop":
                        changes["speed"] = 0.0
                    else:
                        changes[order.name] = _read_number(order)
                except MapctlError as error:
                    notes.append(str(error))
            if changes:
                notes += self._app.change(character, changes)
        self._report(notes)

    def _read(self, notes: list[str]) -> list[tuple[ShownCharacter, list[Order]]]:
        """Return the commands by character: what steers first, then where to go, which keeps the new speed."""
        characters, found = self._app.characters, list[Order]()
        for message in self._source.poll():
            try:
                found.append(read_order(message, characters=len(characters), groups=list(self._app.limits.labels)))
            except RequestError as error:
                notes.append(str(error))
        latest = keep_latest(found)
        journeys = [order for order in latest if order.name in ("place", "path")]
        steering = [order for order in latest if order not in journeys]
        return [
            (character, mine)
            for orders in (steering, journeys)
            for number, character in enumerate(characters)
            if (mine := [order for order in orders if order.character == number])
        ]

    def _actions(self) -> dict[str, Callable[[ShownCharacter, Order], None]]:
        app = self._app
        return {
            "reset": lambda character, order: app.restart(),
            "pause": lambda character, order: app.set_paused(_read_number(order) != 0),
            "disc": lambda character, order: app.set_disc(_read_disc(order)),
            "path": lambda character, order: app.walk(character, _read_points(order.numbers)),
            "place": self._go,
        }

    def _aim(self, character: ShownCharacter, order: Order) -> None:
        point = parse_point(order.numbers) if order.numbers else None
        if order.numbers and point is None:
            raise RequestError(f"{order.name}: the position is too far away")
        if order.name == "look":
            character.inputs = replace(character.inputs, look_at=point)
        else:
            reach = {**character.inputs.reach, HANDS[order.name]: point}
            reach = {hand: at for hand, at in reach.items() if at is not None}
            character.inputs = replace(character.inputs, reach=reach)
        self._app.aim(character)

    def _go(self, character: ShownCharacter, order: Order) -> None:
        (position,) = _read_points(order.numbers[:2])
        asked = order.numbers[2] if len(order.numbers) > 2 else _DEFAULT_WITHIN
        facing = math.radians(math.remainder(order.numbers[3], 360)) if len(order.numbers) > 3 else None
        self._app.targets.go(character, position, min(WITHIN[1], max(WITHIN[0], asked)), facing)

    def _report(self, notes: Sequence[str]) -> None:
        """Print one line in two seconds on what could not be obeyed."""
        now, dropped = time.perf_counter(), self._source.dropped - self._dropped
        notes = [*notes, *([self._source.fault] if dropped else [])]
        if notes and now - self._noted_at >= _NOTE_SECONDS:
            self._noted_at, self._dropped = now, self._source.dropped
            more = f" (and {len(notes) - 1} more)" if len(notes) > 1 else ""
            self._notify(f"OSC: {notes[-1]}{more}")


def _read_number(order: Order) -> float | None:
    """Return the number of a command, of an angle within half a turn either way; None without one."""
    if not order.numbers:
        return None
    return math.remainder(order.numbers[0], 360) if order.name in ("heading", "facing") else order.numbers[0]


def _read_points(numbers: Sequence[float]) -> list[tuple[float, float]]:
    points = list(zip(numbers[::2], numbers[1::2], strict=True))
    if any(parse_point((x, 0.0, z)) is None for x, z in points):
        raise RequestError("the position is too far away")
    return points


def _read_disc(order: Order) -> Obstacle | None:
    if not order.numbers:
        return None
    x, z, radius = order.numbers
    if not DISC_RADII[0] <= radius <= DISC_RADII[1] or parse_point((x, 0.0, z)) is None:
        raise RequestError(f"disc: the radius must be {DISC_RADII[0]:g} to {DISC_RADII[1]:g} m, the position near")
    return Obstacle((x, z), radius)
