"""Colours: one meaning each, the same in every picture. All are sRGB, 0 to 1."""

from collections.abc import Mapping

import numpy as np

from mapctl.errors import RequestError

ACTORS: Mapping[str, str] = {
    "slate": "#5b6675",
    "crimson": "#c9304e",
    "green": "#2f9e62",
    "purple": "#7d55c7",
    "teal": "#1b98a0",
    "brown": "#8d6346",
    "pink": "#d4609f",
    "olive": "#8a8f2e",
    "navy": "#2f4a7d",
    "black": "#33363b",
}
"""Torso colours by name, in the order in which actors without one get them; all differ from the limbs'."""

LEFT = "#2f7fe0"
RIGHT = "#f0862b"
TARGET = "#e0413a"
TRAIL = "#f2b71f"
INK = "#2b3038"
SKIN = "#dcae8f"
HAIR = "#4a3a31"
TROUSERS = "#39414f"
BACKGROUND = "#eef1f5"
GRID = "#9aa5b4"
TILE = "#e4e8ee"
SHADOW = "#1c2430"


def rgb(colour: str) -> np.ndarray:
    """Parse a name of ACTORS or `#rrggbb` to three numbers, 0 to 1; RequestError otherwise."""
    code = ACTORS.get(colour, colour)
    try:
        if len(code) != 7 or not code.startswith("#"):
            raise ValueError
        return np.array([int(code[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    except ValueError:
        raise RequestError(f"colour must be #rrggbb or one of {', '.join(ACTORS)}; got {colour!r}") from None


def default_colour(actor: int) -> str:
    """Return the colour of the n-th actor that has none of its own."""
    return list(ACTORS)[actor % len(ACTORS)]


def blend_colours(colour: np.ndarray, other: np.ndarray, share: float | np.ndarray) -> np.ndarray:
    """Blend `share` of the other colour into the first."""
    return colour + (other - colour) * share
