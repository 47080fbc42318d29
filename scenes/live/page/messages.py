"""What the page's own script sends: JSON objects, each checked as if anybody had sent it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mapctl.errors import RequestError
from mapctl.numerics.checks import is_number
from scenes.live.page.keys import KEYS
from scenes.live.view.framing import Box

MOST_CHARACTERS = 2000
"""Length of the longest message."""
_MOST_KEYS, _AXES, _BUTTONS = 16, 4, 17
_FARTHEST_PIXEL = 20_000


@dataclass(frozen=True)
class HeldKeys:
    """Keys that are held from now on."""

    codes: frozenset[str]
    """Names as KeyboardEvent.code has them."""


@dataclass(frozen=True)
class PadState:
    """Sticks and buttons of a gamepad."""

    axes: tuple[float, ...]
    """Sticks, -1 to 1: left one right and down, right one right and down."""
    buttons: tuple[float, ...]
    """How far each button is pressed, 0 to 1, in the order of the standard mapping."""


@dataclass(frozen=True)
class PadGone:
    """The gamepad was unplugged."""


@dataclass(frozen=True)
class PageLayout:
    """Where things are on the page."""

    size: tuple[float, float]
    """Width and height of the canvas, pixels."""
    panel: Box | None
    """The panel if it lies over the canvas, pixels from the canvas' corner."""
    viewer: int | None
    """Number of viser's client in this page; None until the page knows."""
    prefers_dark: bool
    """Whether the browser asks for dark pages."""


PageMessage = HeldKeys | PadState | PadGone | PageLayout


def parse_message(text: object) -> PageMessage:
    """Parse a message; RequestError where it is none."""
    if not isinstance(text, str) or len(text) > MOST_CHARACTERS:
        raise RequestError("a message that is no short text")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        raise RequestError("a message that is no JSON") from None
    if not isinstance(message, dict) or len(message) != 1:
        raise RequestError("a message that is no object of one kind")
    ((kind, content),) = message.items()
    if kind not in _PARSERS:
        raise RequestError(f"a message of an unknown kind {str(kind)[:20]!r}")
    return _PARSERS[kind](content)


def _parse_keys(content: Any) -> HeldKeys:
    if not isinstance(content, list) or len(content) > _MOST_KEYS or not all(one in KEYS for one in map(str, content)):
        raise RequestError("keys that are not listed")
    return HeldKeys(frozenset(map(str, content)))


def _parse_pad(content: Any) -> PadState | PadGone:
    if content is None:
        return PadGone()
    if not isinstance(content, dict):
        raise RequestError("a gamepad that is none")
    axes, buttons = (_parse_numbers(content.get(name), -1.5, 1.5) for name in ("axes", "buttons"))
    if len(axes) > _AXES or len(buttons) > _BUTTONS:
        raise RequestError("a gamepad with too much on it")
    return PadState(axes + (0.0,) * (_AXES - len(axes)), buttons + (0.0,) * (_BUTTONS - len(buttons)))


def _parse_layout(content: Any) -> PageLayout:
    if not isinstance(content, dict):
        raise RequestError("a layout that is none")
    canvas = _parse_box(content.get("canvas"))
    panel = None if content.get("panel") is None else _parse_box(content.get("panel"))
    viewer = content.get("viewer")
    if canvas.width < 1 or canvas.height < 1 or not (viewer is None or (type(viewer) is int and viewer >= 0)):
        raise RequestError("a layout without a canvas")
    moved = None if panel is None else panel._replace(left=panel.left - canvas.left, top=panel.top - canvas.top)
    return PageLayout((canvas.width, canvas.height), moved, viewer, content.get("dark") is True)


def _parse_box(content: Any) -> Box:
    numbers = _parse_numbers(content, -_FARTHEST_PIXEL, _FARTHEST_PIXEL)
    if len(numbers) != 4:
        raise RequestError("a rectangle that is none")
    return Box(*numbers)


def _parse_numbers(content: Any, low: float, high: float) -> tuple[float, ...]:
    if not isinstance(content, Sequence) or isinstance(content, str):
        raise RequestError("numbers that are none")
    if not all(is_number(one) and low <= one <= high for one in content):
        raise RequestError("numbers that cannot be")
    return tuple(float(one) for one in content)


_PARSERS = {"keys": _parse_keys, "pad": _parse_pad, "layout": _parse_layout}
