"""Colours of the live viewer's two themes. Bodies and marks keep theirs, so that a colour means the same in both."""

from dataclasses import dataclass

from mapctl.mesh import colours

THEMES = ("light", "dark", "auto")
"""Choices of a theme; `auto` is what each browser prefers."""


@dataclass(frozen=True)
class Theme:
    """Colours of ground, sky and light."""

    dark: bool
    """Whether the panel is dark."""
    zenith: str
    """Sky overhead, `#rrggbb`."""
    horizon: str
    """Sky at the horizon, into which the ground fades."""
    floor: str
    """Ground."""
    line: str
    """Lines of a metre."""
    strong_line: str
    """Lines of five metres."""
    shadow: float
    """Opacity of shadows on the ground, 0 to 1."""
    key: float
    """Strength of the lamp that throws shadows."""
    fill: float
    """Strength of the light from all sides."""


LIGHT = Theme(
    dark=False,
    zenith="#b9c9de",
    horizon=colours.BACKGROUND,
    floor="#dfe4eb",
    line="#b9c2ce",
    strong_line=colours.GRID,
    shadow=0.32,
    key=1.7,
    fill=0.42,
)
DARK = Theme(
    dark=True,
    zenith="#10151d",
    horizon="#39434f",
    floor="#2b333d",
    line="#3d4754",
    strong_line="#566273",
    shadow=0.55,
    key=2.0,
    fill=0.3,
)
