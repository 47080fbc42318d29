"""Inputs of one character: what the page, held keys, gamepads and other programs may ask for, and its limits."""

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from mapctl.intent.steering import STEP_LENGTHS, Command
from mapctl.streaming.orders import is_number
from scenes.live.page import Gamepad, PageState

UNCONDITIONED = "any"
"""The choice that gives a prior no label."""
HANDS = ("left", "right")
DISC_RADII = (0.2, 2.0)
"""Smallest and largest disc to walk round, metres."""
WITHIN = (0.5, 10.0)
"""Shortest and longest time in which a character can be sent to a position, seconds."""
Point = tuple[float, float, float]
_MAX_COORDINATE = 1e4  # metres from the origin
_UNITS = {"speed": "m/s", "step_length": "m", "heading": "degrees", "facing": "degrees"}


@dataclass(frozen=True)
class SteeringInputs:
    """What one character is asked for, as the panel shows it."""

    speed: float = 1.2
    """Speed, m/s."""
    heading: float = 0.0
    """Direction of travel, degrees; 0 is +Z, 90 is +X."""
    facing: float | None = None
    """Facing, degrees; None faces the direction of travel."""
    step_length: float | None = None
    """Step length, metres; None leaves it to the prior."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Chosen label by group (gait, style)."""
    reach: Mapping[str, Point] = field(default_factory=dict)
    """Targets of hands in the world, metres, by `left` and `right`."""
    look_at: Point | None = None
    """Target of the head in the world, metres."""

    @property
    def command(self) -> Command:
        """Command for a LiveCharacter."""
        return Command(
            self.speed,
            math.radians(self.heading),
            None if self.facing is None else math.radians(self.facing),
            step_length=self.step_length,
            labels=tuple(f"{group}={label}" for group, label in self.labels.items()),
            reach={f"{hand}Hand": point for hand, point in self.reach.items()},
            look_at=self.look_at,
        )


@dataclass(frozen=True)
class InputLimits:
    """Limits of what can be asked of a prior."""

    fastest: float
    """Fastest speed, m/s."""
    labels: Mapping[str, Sequence[str]]
    """Labels of the prior, by group."""

    def change(self, inputs: SteeringInputs, changes: Mapping[str, Any]) -> tuple[SteeringInputs, list[str]]:
        """Change inputs by name, each limited to what is possible; also return a sentence for each that was limited.

        A value that is not a finite number changes nothing. `labels` holds a label by group, UNCONDITIONED for none.
        """
        found, notes = {}, list[str]()
        for name, asked in changes.items():
            if name == "labels":
                found[name], unknown = self._change_labels(inputs.labels, asked)
                notes += [f"{label!r} is not a {group} of this prior." for group, label in unknown.items()]
            elif is_number(asked):
                found[name] = self._limit(name, float(asked))
                if name in ("speed", "step_length") and found[name] != asked:
                    low, high = self._range(name)
                    words, unit = name.replace("_", " "), _UNITS[name]
                    notes.append(f"A {words} of {asked:g} {unit} is out of range: {low:g} to {high:g} {unit}.")
            elif asked is None and name in ("facing", "step_length"):
                found[name] = None
            else:
                notes.append(f"{str(asked)[:20]!r} is not a {name.replace('_', ' ')} in {_UNITS[name]}.")
        return replace(inputs, **found), notes

    def _range(self, name: str) -> tuple[float, float]:
        return (0.0, self.fastest) if name == "speed" else STEP_LENGTHS

    def _limit(self, name: str, value: float) -> float:
        if name in ("heading", "facing"):
            return value if abs(value) <= 180 else math.remainder(value, 360)
        low, high = self._range(name)
        return min(high, max(low, value))

    def _change_labels(
        self, labels: Mapping[str, str], asked: Mapping[str, str]
    ) -> tuple[dict[str, str], dict[str, str]]:
        known = {
            group: label
            for group, label in asked.items()
            if group in self.labels and label in (UNCONDITIONED, *self.labels[group])
        }
        changed = {group: label for group, label in {**labels, **known}.items() if label != UNCONDITIONED}
        return changed, {group: label for group, label in asked.items() if group not in known}


def parse_point(value: object) -> Point | None:
    """Return a position that a browser or another program sent, metres; None unless it is finite and near."""
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    if found.shape != (3,) or not np.isfinite(found).all() or np.abs(found).max() > _MAX_COORDINATE:
        return None
    return float(found[0]), float(found[1]), float(found[2])


class KeyAction(Enum):
    """What a key does when it is pressed."""

    STAND = "stand"
    TURN_AROUND = "turn around"
    PAUSE = "pause or resume"
    RESET = "reset"
    WALK_PATH = "walk the drawn path"
    CAMERA = "next camera: chase, follow, stay"
    SHOW_ALL = "bring all characters into view"
    NEXT = "next character"
    HELP = "show or hide this list"


ACTIONS = {
    "KeyX": KeyAction.STAND,
    "KeyB": KeyAction.TURN_AROUND,
    "KeyP": KeyAction.PAUSE,
    "KeyR": KeyAction.RESET,
    "KeyG": KeyAction.WALK_PATH,
    "KeyV": KeyAction.CAMERA,
    "KeyF": KeyAction.SHOW_ALL,
    "KeyN": KeyAction.NEXT,
    "KeyH": KeyAction.HELP,
}
"""Keys that do one thing, by KeyboardEvent.code."""
BUTTONS = {0: KeyAction.STAND, 1: KeyAction.TURN_AROUND, 2: KeyAction.CAMERA, 3: KeyAction.NEXT, 9: KeyAction.PAUSE}
"""Buttons of a gamepad that do one thing: A, B, X, Y and Start."""
DIRECTIONS = {
    **dict.fromkeys(("KeyW", "ArrowUp"), (0.0, 1.0)),
    **dict.fromkeys(("KeyS", "ArrowDown"), (0.0, -1.0)),
    **dict.fromkeys(("KeyA", "ArrowLeft"), (-1.0, 0.0)),
    **dict.fromkeys(("KeyD", "ArrowRight"), (1.0, 0.0)),
}
"""Keys that walk: to the right of the camera and away from it."""
TURNS = {"KeyQ": 1.0, "KeyE": -1.0}
"""Keys that orbit the camera to the left and to the right."""
FAST = frozenset(("ShiftLeft", "ShiftRight"))
KEYS = (*ACTIONS, *DIRECTIONS, *TURNS, *sorted(FAST))
"""All keys that the page sends."""
HELP = (
    ("W A S D", "walk in that direction as seen from the camera, as arrows do; release to stand"),
    ("Shift", "run"),
    ("Q E", "orbit the camera"),
    *((code.removeprefix("Key"), action.value) for code, action in ACTIONS.items()),
    ("Gamepad", "left stick walks, right trigger runs, right stick orbits, A stands, Y next character"),
    ("Mouse", "drag to orbit, wheel to zoom, right drag to pan"),
)
"""Keys and what they do, as the page lists them."""

_DEAD, _FULL = 0.18, 0.95  # shares of a stick's travel that count as none and as all
_RUN_TRIGGER, _PRESSED = 7, 0.5
_ORDER_SECONDS, _LEAST_TURN, _LEAST_SPEED = 0.1, 2.0, 0.05  # between inputs; degrees and m/s that make another one
_ORBIT_RATE = math.radians(100.0)  # radians/s


@dataclass
class Driving:
    """Held keys and sticks of each page; the first page that drives is obeyed until it releases its controls. The
    character stands when keys are released, the gamepad is unplugged, or the page goes away."""

    steer: Callable[[float, float | None], None]
    """Steer at a speed, m/s, in a heading, degrees; None keeps it."""
    act: Callable[[KeyAction], None]
    """Do what a key does."""
    orbit: Callable[[float], None]
    """Orbit the camera to the left, radians."""
    find_heading: Callable[[tuple[float, float], int | None], float]
    """Return the heading, degrees, of a direction to the right and away as a viewer's camera sees it."""
    notify: Callable[[str, str], None]
    """Show a note: title and text."""
    fastest: float
    """The prior's fastest speed, m/s."""
    walk_speed: float = 1.2
    """Speed of a held key, m/s; Shift runs."""
    _pages: dict[int, PageState] = field(default_factory=dict)
    _driver: int | None = None
    _given: tuple[float, float] | None = None
    _given_at: float = -math.inf
    _stepped: float | None = None

    def hear(self, page: int, state: PageState | None) -> None:
        """Take the state of a page; None if it is gone."""
        before = self._pages.pop(page, PageState())
        if state is None:
            return
        self._pages[page] = state
        for code in sorted(state.keys - before.keys):
            if code in ACTIONS:
                self.act(ACTIONS[code])
        for action in list_presses(before.pad, state.pad):
            self.act(action)
        if (before.pad is None) != (state.pad is None):
            plugged = "left stick walks, right trigger runs" if state.pad else "unplugged; the character stands"
            self.notify("Gamepad", plugged)

    def step(self, now: float) -> None:
        """Act on what is held at a value of time.perf_counter."""
        seconds = 0.0 if self._stepped is None else min(0.1, now - self._stepped)
        self._stepped = now
        for page in self._pages.values():
            turn = sum(TURNS.get(code, 0.0) for code in page.keys) - (0.0 if page.pad is None else _read_look(page.pad))
            if turn:
                self.orbit(turn * _ORBIT_RATE * seconds)
        self._drive(now)

    def _drive(self, now: float) -> None:
        wanted = {number: asked for number, page in self._pages.items() if (asked := self._read(page)) is not None}
        if self._driver not in wanted:
            was, self._driver = self._driver, next(iter(wanted), None)
            if was is not None and self._driver is None:
                self._given = None
                self.steer(0.0, None)
        if self._driver is None:
            return
        direction, speed = wanted[self._driver]
        heading = self.find_heading(direction, self._pages[self._driver].viewer)
        if self._is_new(speed, heading, now):
            self._given, self._given_at = (speed, heading), now
            self.steer(speed, heading)

    def _read(self, page: PageState) -> tuple[tuple[float, float], float] | None:
        """Return direction and speed that a page asks for; None where it asks for none."""
        run_speed = max(self.walk_speed, 0.75 * self.fastest)
        if page.pad is not None:
            right, down = page.pad.axes[:2]
            if push := _scale(math.hypot(right, down)):
                trigger = min(1.0, max(0.0, page.pad.buttons[_RUN_TRIGGER]))
                top = self.walk_speed + (run_speed - self.walk_speed) * trigger
                length = math.hypot(right, down)
                return (right / length, -down / length), round(max(0.3, top * push), 2)
        direction = find_direction(page.keys)
        if direction is None:
            return None
        return direction, run_speed if page.keys & FAST else self.walk_speed

    def _is_new(self, speed: float, heading: float, now: float) -> bool:
        if self._given is None:
            return True
        changed = abs(speed - self._given[0]) >= _LEAST_SPEED
        changed |= abs(math.remainder(heading - self._given[1], 360)) >= _LEAST_TURN
        return changed and now - self._given_at >= _ORDER_SECONDS


def find_direction(codes: Set[str]) -> tuple[float, float] | None:
    """Return the unit direction of held keys, to the right and away; None where they ask for none."""
    held = {DIRECTIONS[code] for code in codes if code in DIRECTIONS}
    right, away = sum(one[0] for one in held), sum(one[1] for one in held)
    length = math.hypot(right, away)
    return None if length == 0 else (right / length, away / length)


def list_presses(before: Gamepad | None, now: Gamepad | None) -> list[KeyAction]:
    """List the actions of buttons that were pressed since the state before."""
    if now is None:
        return []
    old = (0.0,) * len(now.buttons) if before is None else before.buttons
    return [action for k, action in BUTTONS.items() if old[k] < _PRESSED <= now.buttons[k]]


def _read_look(pad: Gamepad) -> float:
    """Return how fast the right stick orbits to the right, -1 to 1."""
    return math.copysign(_scale(abs(pad.axes[2])), pad.axes[2])


def _scale(length: float) -> float:
    return min(1.0, max(0.0, (length - _DEAD) / (_FULL - _DEAD)))
