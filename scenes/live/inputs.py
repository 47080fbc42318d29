"""Held keys and sticks, which steer the chosen character, and limits of what users and programs send."""

import math
from collections.abc import Set
from typing import TYPE_CHECKING, Any

from mapctl.arguments import read_number, read_point
from mapctl.errors import RequestError
from scenes.live.page import PageState

if TYPE_CHECKING:
    from scenes.live.app import LiveApp

UNCONDITIONED = "any"
"""The choice that gives a prior no label."""
DISC_RADII = (0.2, 2.0)
"""Smallest and largest disc to walk round, metres."""
WITHIN = (0.5, 10.0)
"""Shortest and longest time in which a character can be sent to a position, seconds."""
Point = tuple[float, float, float]
_MAX_COORDINATE = 1e4  # metres from the origin


def read_position(values: Any) -> Point:
    """Return a position that a browser or another program sent, metres; RequestError unless it is finite and near."""
    x, y, z = read_point(values, 3, "a position")
    if max(abs(x), abs(y), abs(z)) > _MAX_COORDINATE:
        raise RequestError(f"a position must be within {_MAX_COORDINATE:g} m of the origin")
    return x, y, z


def read_degrees(value: Any) -> float:
    """Return an angle that a browser or another program sent in degrees, radians, within half a turn."""
    return math.radians(math.remainder(read_number(value, "an angle"), 360))


ACTIONS = {
    "KeyX": "stand",
    "KeyL": "keep facing the target, or where the camera looks now; again to end that",
    "KeyP": "pause or resume",
    "KeyR": "reset",
    "KeyN": "next character",
    "KeyH": "show or hide this list",
}
"""Action of a pressed key, by KeyboardEvent.code."""
DIRECTIONS = {
    **dict.fromkeys(("KeyW", "ArrowUp"), (0.0, 1.0)),
    **dict.fromkeys(("KeyS", "ArrowDown"), (0.0, -1.0)),
    **dict.fromkeys(("KeyA", "ArrowLeft", "KeyQ"), (-1.0, 0.0)),
    **dict.fromkeys(("KeyD", "ArrowRight", "KeyE"), (1.0, 0.0)),
}
"""Keys that walk: to the right of the camera and away from it."""
STRAFE = frozenset(("KeyQ", "KeyE"))
"""Keys of these that keep the facing."""
FAST = frozenset(("ShiftLeft", "ShiftRight"))
KEYS = (*ACTIONS, *DIRECTIONS, *sorted(FAST))
"""All keys that the page sends."""
HELP = (
    ("W A S D", "walk in that direction as seen from the camera, as arrows do; release to stand"),
    ("Q E", "walk to the left or right and keep the facing"),
    ("Shift", "run"),
    *((code.removeprefix("Key"), action) for code, action in ACTIONS.items()),
    ("Gamepad", "left stick walks, right stick faces, right trigger runs"),
    ("Mouse", "drag to orbit, wheel to zoom, right drag to pan"),
)
"""Keys and what they do, as the page lists them."""

_DEAD, _FULL = 0.18, 0.95  # shares of a stick's travel that count as none and as all
_ORDER_SECONDS, _LEAST_SPEED = 0.1, 0.05  # between orders; m/s that make another one
_LEAST_TURN = math.radians(2.0)  # that makes another one
Steering = tuple[float, float | None, float | None]
"""Speed, m/s, heading and facing, radians; None keeps the heading, and faces the direction of travel."""


class Driving:
    """Held keys and sticks of each page; the first page that holds some is obeyed, and the character stands when all
    are released or their page is gone."""

    def __init__(self, app: "LiveApp"):
        self._app = app
        self.walk_speed = min(1.2, app.fastest)
        """Speed of a held key, m/s; Shift runs."""
        self._pages: dict[int, PageState] = {}
        self._given: Steering | None = None
        self._given_at = -math.inf
        self._kept: float | None = None  # facing while it strafes, radians

    def update(self, page: int, state: PageState | None) -> None:
        """Take the state of a page; None if it is gone."""
        if state is None:
            self._pages.pop(page, None)
            return
        before = self._pages.get(page, PageState())
        self._pages[page] = state
        for code in sorted((state.keys - before.keys) & ACTIONS.keys()):
            self._app.act(code)

    def step(self, now: float) -> None:
        """Steer by what is held at a value of time.perf_counter."""
        asked = next((found for page in self._pages.values() if (found := self._read(page)) is not None), None)
        before = self._given
        if asked is None:
            self._given = self._kept = None
            if before is not None:
                self._app.steer(0.0, None, before[2])
        elif before is None or (_differ(asked, before) and now - self._given_at >= _ORDER_SECONDS):
            self._given, self._given_at = asked, now
            self._app.steer(*asked)

    def _read(self, page: PageState) -> Steering | None:
        """Return what a page asks for; None where it asks for nothing."""
        run_speed = max(self.walk_speed, 0.75 * self._app.fastest)
        direction, speed = find_direction(page.keys), run_speed if page.keys & FAST else self.walk_speed
        if page.stick is not None and (pushed := _push(page.stick)) is not None:
            direction, push = pushed
            top = self.walk_speed + (run_speed - self.walk_speed) * max(0.0, page.stick[2])
            speed = round(max(0.3, top * push), 2)
        facing = None
        if (aimed := _push(page.aim)) is not None:
            facing = self._app.view.find_heading(aimed[0], page.viewer)
        elif direction is not None and (locked := self._app.find_lock()) is not None:
            facing = locked
        elif page.keys & STRAFE:
            self._kept = facing = self._app.chosen.facing if self._kept is None else self._kept
        if direction is None:
            return None if facing is None else (0.0, None, facing)
        return speed, self._app.view.find_heading(direction, page.viewer), facing


def _push(stick: tuple[float, ...] | None) -> tuple[tuple[float, float], float] | None:
    """Return the direction of a stick, to the right and away, and how far it is pushed, 0 to 1; None at rest."""
    length = 0.0 if stick is None else math.hypot(*stick[:2])
    if stick is None or length <= _DEAD:
        return None
    return (stick[0] / length, -stick[1] / length), min(1.0, (length - _DEAD) / (_FULL - _DEAD))


def _differ(one: Steering, other: Steering) -> bool:
    """Return whether two requests differ by more than the camera's sway."""
    turned = [
        a is not b if a is None or b is None else abs(math.remainder(a - b, math.tau)) >= _LEAST_TURN
        for a, b in zip(one[1:], other[1:], strict=True)
    ]
    return any(turned) or abs(one[0] - other[0]) >= _LEAST_SPEED


def find_direction(codes: Set[str]) -> tuple[float, float] | None:
    """Return the unit direction of held keys, to the right and away; None where they ask for none."""
    held = {DIRECTIONS[code] for code in codes if code in DIRECTIONS}
    right, away = sum(one[0] for one in held), sum(one[1] for one in held)
    length = math.hypot(right, away)
    return None if length == 0 else (right / length, away / length)
