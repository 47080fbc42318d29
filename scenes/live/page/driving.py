"""Keys and gamepads of all pages, as orders for the chosen character."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from scenes.live.page.gamepad import list_presses, read_pad
from scenes.live.page.keys import ACTIONS, DIRECTIONS, FAST, TURNS, KeyAction, KeyRepeat, find_direction
from scenes.live.page.messages import HeldKeys, PadGone, PadState, PageMessage

_SPEED_STEP, _HEADING_STEP = 0.2, 15.0  # m/s and degrees of one press of a key, where keys steer as the character goes
_LARGE = 2.0  # times these with Shift
_ORDER_SECONDS, _LEAST_TURN, _LEAST_SPEED = 0.1, 2.0, 0.05  # between orders; degrees and m/s that make another one
_TURN_RATE = math.radians(100.0)  # of the camera, a second


@runtime_checkable
class DriverActions(Protocol):
    """What keys and sticks ask for."""

    def order(self, **changes: Any) -> None:
        """Change the chosen character's orders by name."""
        ...

    def nudge(self, **by: float) -> None:
        """Add to the chosen character's speed or heading."""
        ...

    def act(self, action: KeyAction) -> None:
        """Do what a key does."""
        ...

    def turn_camera(self, angle: float) -> None:
        """Turn the camera round the character to the left, radians."""
        ...

    def find_heading(self, direction: tuple[float, float], viewer: int | None) -> float:
        """Return the heading, degrees, of what is to the right and away as a viewer's camera sees it."""
        ...


@dataclass
class _Page:
    keys: frozenset[str] = frozenset()
    pad: PadState | None = None
    viewer: int | None = None


class Driving:
    """Held keys and sticks of each page; whoever lets go, goes away or is unplugged has the character stand."""

    def __init__(self, deck: DriverActions, *, fastest: float, tell: Callable[[str, str], None]):
        """`fastest` is the prior's, m/s; `tell` shows a note: what of, and the text."""
        self._deck, self._fastest, self._tell = deck, fastest, tell
        self.from_camera = True
        """Whether W, A, S and D are as the camera sees it, or faster, slower and turns."""
        self.walk_speed = min(1.2, fastest)
        """Speed of a key that is held, m/s; with Shift it runs."""
        self._pages: dict[int, _Page] = {}
        self._repeat: dict[int, KeyRepeat] = {}
        self._driver: int | None = None  # the page whose keys or stick the character obeys
        self._given: tuple[float, float] | None = None
        self._given_at, self._stepped = -math.inf, math.nan

    @property
    def run_speed(self) -> float:
        """Speed with Shift, m/s."""
        return max(self.walk_speed, 0.75 * self._fastest)

    def hear(self, page: int, message: PageMessage | None) -> None:
        """Take what a page sent, None if it is gone."""
        one = self._pages.setdefault(page, _Page())
        if message is None:
            del self._pages[page]
            self._repeat.pop(page, None)
        elif isinstance(message, HeldKeys):
            for code in sorted(message.codes - one.keys):
                if code in ACTIONS:
                    self._deck.act(ACTIONS[code])
            if not self.from_camera:
                self._nudge(message.codes - one.keys, message.codes)
            one.keys = message.codes
        elif isinstance(message, PadState):
            for action in list_presses(one.pad, message):
                self._deck.act(action)
            if one.pad is None:
                self._tell("Gamepad", "it steers: left stick walks, right trigger runs")
            one.pad = message
        elif isinstance(message, PadGone):
            if one.pad is not None:
                self._tell("Gamepad", "it was unplugged; the character stands")
            one.pad = None
        else:
            one.viewer = message.viewer

    def step(self, now: float) -> None:
        """Give the orders of what is held now, a value of time.perf_counter."""
        seconds = 0.0 if math.isnan(self._stepped) else min(0.1, now - self._stepped)
        self._stepped = now
        for number, page in self._pages.items():
            turn = sum(TURNS[code] for code in page.keys if code in TURNS)
            turn += 0.0 if page.pad is None else read_pad(page.pad).turn
            if turn:
                self._deck.turn_camera(turn * _TURN_RATE * seconds)
            if not self.from_camera:
                repeat = self._repeat.setdefault(number, KeyRepeat())
                self._nudge(repeat.due(page.keys & DIRECTIONS.keys(), now), page.keys)
        self._drive(now)

    def _drive(self, now: float) -> None:
        wishes = {number: wish for number, page in self._pages.items() if (wish := self._read(page)) is not None}
        if self._driver not in wishes:
            was, self._driver = self._driver, next(iter(wishes), None)
            if was is not None and self._driver is None:
                self._given = None
                self._deck.order(speed=0.0)
        if self._driver is None:
            return
        direction, speed = wishes[self._driver]
        heading = self._deck.find_heading(direction, self._pages[self._driver].viewer)
        if self._is_new(speed, heading, now):
            self._given, self._given_at = (speed, heading), now
            self._deck.order(speed=speed, heading=heading)

    def _read(self, page: _Page) -> tuple[tuple[float, float], float] | None:
        """Return the direction and the speed that a page asks for, None where it asks for none."""
        if page.pad is not None and (wish := read_pad(page.pad)).direction is not None:
            top = self.walk_speed + (self.run_speed - self.walk_speed) * wish.run
            return wish.direction, round(max(0.3, top * wish.strength), 2)
        direction = find_direction(page.keys) if self.from_camera else None
        if direction is None:
            return None
        return direction, self.run_speed if page.keys & FAST else self.walk_speed

    def _is_new(self, speed: float, heading: float, now: float) -> bool:
        if self._given is None:
            return True
        changed = abs(speed - self._given[0]) >= _LEAST_SPEED
        changed |= abs(math.remainder(heading - self._given[1], 360)) >= _LEAST_TURN
        return changed and now - self._given_at >= _ORDER_SECONDS

    def _nudge(self, acting: Any, held: frozenset[str]) -> None:
        times = _LARGE if held & FAST else 1.0
        for code in acting:
            if code in DIRECTIONS:
                right, away = DIRECTIONS[code]
                if away:
                    self._deck.nudge(speed=times * away * _SPEED_STEP)
                else:
                    self._deck.nudge(heading=-times * right * _HEADING_STEP)
