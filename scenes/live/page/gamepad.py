"""Sticks and buttons of a gamepad, in the order of the browser's standard mapping."""

import math
from dataclasses import dataclass

from scenes.live.page.keys import KeyAction
from scenes.live.page.messages import PadState

_DEAD, _FULL = 0.18, 0.95  # shares of a stick's way that count as none and as all
_RUN_TRIGGER = 7
_PRESSED = 0.5
BUTTONS = {0: KeyAction.STAND, 1: KeyAction.TURN_ROUND, 2: KeyAction.CAMERA, 3: KeyAction.NEXT, 9: KeyAction.PAUSE}
"""Buttons that do one thing: A, B, X, Y and Start."""


@dataclass(frozen=True)
class PadWish:
    """What a gamepad asks for."""

    direction: tuple[float, float] | None
    """Unit direction to the right and away from the camera; None while the stick rests."""
    strength: float
    """How far the stick is pushed, 0 to 1."""
    run: float
    """How far the trigger is pulled, 0 to 1."""
    turn: float
    """How fast the camera turns to the left, -1 to 1."""


def read_pad(state: PadState) -> PadWish:
    """Read what a gamepad asks for."""
    right, down, look, _ = state.axes
    length = math.hypot(right, down)
    strength = _scale(length)
    direction = (right / length, -down / length) if strength > 0 else None
    return PadWish(
        direction, strength, min(1.0, max(0.0, state.buttons[_RUN_TRIGGER])), -math.copysign(_scale(abs(look)), look)
    )


def list_presses(before: PadState | None, now: PadState) -> list[KeyAction]:
    """List what the buttons do that were pressed since the state before."""
    old = (0.0,) * len(now.buttons) if before is None else before.buttons
    return [action for k, action in BUTTONS.items() if old[k] < _PRESSED <= now.buttons[k]]


def _scale(length: float) -> float:
    return min(1.0, max(0.0, (length - _DEAD) / (_FULL - _DEAD)))
