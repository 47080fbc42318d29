"""Keys of the page: what each does, and when one that is held does it again."""

import math
from collections.abc import Mapping, Set
from enum import Enum


class KeyAction(Enum):
    """What a key does when it is pressed."""

    STAND = "stand"
    TURN_ROUND = "turn round"
    PAUSE = "pause or go on"
    RESET = "reset"
    WALK_PATH = "walk the drawn path"
    CAMERA = "next camera: turning, following, staying"
    SHOW_ALL = "bring everybody into view"
    NEXT = "next character"
    HELP = "show or hide this list"


ACTIONS: Mapping[str, KeyAction] = {
    "KeyX": KeyAction.STAND,
    "KeyB": KeyAction.TURN_ROUND,
    "KeyP": KeyAction.PAUSE,
    "KeyR": KeyAction.RESET,
    "KeyG": KeyAction.WALK_PATH,
    "KeyV": KeyAction.CAMERA,
    "KeyF": KeyAction.SHOW_ALL,
    "KeyN": KeyAction.NEXT,
    "KeyH": KeyAction.HELP,
}
"""Keys that do one thing, by KeyboardEvent.code."""
DIRECTIONS: Mapping[str, tuple[float, float]] = {
    "KeyW": (0.0, 1.0),
    "ArrowUp": (0.0, 1.0),
    "KeyS": (0.0, -1.0),
    "ArrowDown": (0.0, -1.0),
    "KeyA": (-1.0, 0.0),
    "ArrowLeft": (-1.0, 0.0),
    "KeyD": (1.0, 0.0),
    "ArrowRight": (1.0, 0.0),
}
"""Keys that steer: to the right and away from the camera."""
TURNS: Mapping[str, float] = {"KeyQ": 1.0, "KeyE": -1.0}
"""Keys that turn the camera round the character: to the left, and to the right."""
FAST = frozenset(("ShiftLeft", "ShiftRight"))
"""Keys that make the others faster."""
KEYS = frozenset((*ACTIONS, *DIRECTIONS, *TURNS, *FAST))
"""All keys that the page sends."""

REPEAT_AFTER, REPEAT_EVERY = 0.35, 0.1
"""Seconds until a held key acts again, and between the times after that."""


def list_help(*, from_camera: bool) -> list[tuple[str, str]]:
    """List keys and what they do, as the page shows it; `from_camera` as in KeyDirection."""
    steer = [("W A S D", "walk that way as the camera sees it, as arrows do; let go to stand"), ("Shift", "run")]
    if not from_camera:
        steer = [("W S", "faster, slower"), ("A D", "turn"), ("Shift", "in larger steps")]
    turn = ("Q E", "turn the camera")
    single = [(code.removeprefix("Key"), action.value) for code, action in ACTIONS.items()]
    pad = ("Gamepad", "left stick walks, right trigger runs, right stick turns the camera, A stands, Y next character")
    return [*steer, turn, *single, pad, ("Mouse", "drag to orbit, wheel to zoom, right drag to shift")]


def find_direction(codes: Set[str]) -> tuple[float, float] | None:
    """Return the unit direction of held keys, to the right and away; None where they ask for none."""
    x = sum(way[0] for way in {DIRECTIONS[code] for code in codes if code in DIRECTIONS})
    y = sum(way[1] for way in {DIRECTIONS[code] for code in codes if code in DIRECTIONS})
    length = math.hypot(x, y)
    return None if length == 0 else (x / length, y / length)


class KeyRepeat:
    """When held keys act again; the first time is when they are pressed."""

    def __init__(self):
        self._next: dict[str, float] = {}

    def due(self, codes: Set[str], now: float) -> list[str]:
        """Return which of the held keys act again now, a value of time.perf_counter, in the order of their names; one
        that was missed for long acts once."""
        self._next = {code: at for code, at in self._next.items() if code in codes}
        acting = []
        for code in sorted(codes):
            if code not in self._next:
                self._next[code] = now + REPEAT_AFTER
            elif now >= self._next[code]:
                acting.append(code)
                self._next[code] = now + REPEAT_EVERY
        return acting
