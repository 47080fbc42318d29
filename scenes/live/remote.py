"""Commands of other programs over OSC, obeyed by live characters."""

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mapctl.curves.obstacles import Obstacle
from mapctl.errors import MapctlError, RequestError
from mapctl.streaming.orders import HANDS, Order, keep_latest, read_order
from scenes.live.character import ShownCharacter
from scenes.live.inputs import DISC_RADII, WITHIN, parse_point

if TYPE_CHECKING:  # python-osc may not be installed
    from mapctl.streaming.receiver import OscReceiver
    from scenes.live.app import LiveApp

_DEFAULT_WITHIN = 2.0  # seconds in which a character is sent to a position, unless the command has a time
_REPORT_SECONDS = 2.0  # between two lines on the console, however many commands there are


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
                reach = {**character.inputs.reach, HANDS[order.name]: _read_position(order)}
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
