"""Labels in two columns beside a drawing, each with a line to its point, none over another.

Imported late, where they are needed: matplotlib may not be installed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib import font_manager

_MAX_NAME = 24  # characters of a name
_GAP = 0.056  # of the height of the axes between two labels
_TOP, _BOTTOM = 0.965, 0.035  # of the height of the axes
_HAN_FONTS = ("Noto Sans CJK JP", "Noto Sans CJK SC", "IPAexGothic", "IPAGothic", "WenQuanYi Zen Hei", "Yu Gothic")


@dataclass(frozen=True)
class Label:
    """A label with two lines."""

    title: str
    """Its first line."""
    name: str
    """Its second line, smaller."""
    colour: str
    """Colour of its first line."""
    leader: str
    """Colour of the line to its point."""
    point: tuple[float, float]
    """What it is the label of, in data coordinates."""
    on_right: bool
    """Whether it stands in the right column."""


def draw_columns(axes: Any, labels: Sequence[Label]) -> None:
    """Draw labels at both edges of the axes, in the order of the heights of their points."""
    for on_right in (False, True):
        own = sorted((label for label in labels if label.on_right == on_right), key=_order)
        for label, height in zip(own, spread([_to_height(axes, label) for label in own]), strict=True):
            _draw(axes, label, height)


def _order(label: Label) -> tuple[float, float]:
    """Return what orders labels from the top: of points at one height the innermost first, so that no lines cross."""
    return -round(label.point[1], 2), abs(label.point[0])


def spread(heights: Sequence[float]) -> list[float]:
    """Move heights, highest first, apart to at least the gap between two labels, within the axes, and as little as
    that takes."""
    gap = min(_GAP, (_TOP - _BOTTOM) / max(len(heights) - 1, 1))
    placed, top = [], _TOP
    for number, height in enumerate(heights):
        least = _BOTTOM + gap * (len(heights) - 1 - number)
        placed.append(max(min(height, top), least))
        top = placed[-1] - gap
    return placed


def font_families(text: str) -> list[str]:
    """Return the fonts for a text: with one that has its Chinese and Japanese characters, where one is installed."""
    known = {font.name for font in font_manager.fontManager.ttflist}
    return ["DejaVu Sans", *(font for font in _HAN_FONTS if font in known and not text.isascii())]


def printable(name: str) -> str:
    """Return a name as the fonts at hand can show it: other characters as their code."""
    fonts = [font_manager.get_font(font_manager.findfont(family)) for family in font_families(name)]
    shown = "".join(c if any(font.get_char_index(ord(c)) for font in fonts) else f"\\u{ord(c):04x}" for c in name)
    return shown


def shorten(name: str) -> str:
    """Shorten a long name in its middle."""
    return name if len(name) <= _MAX_NAME else name[: _MAX_NAME // 2] + "..." + name[3 - _MAX_NAME // 2 :]


def _to_height(axes: Any, label: Label) -> float:
    low, high = axes.get_ylim()
    return (label.point[1] - low) / (high - low)


def _draw(axes: Any, label: Label, height: float) -> None:
    low, high = axes.get_xlim()
    bottom, top = axes.get_ylim()
    edge, align = (0.995, "right") if label.on_right else (0.005, "left")
    corner = 0.815 if label.on_right else 0.185
    place = dict(transform=axes.transAxes, ha=align, zorder=6)
    axes.text(edge, height + 0.003, label.title, fontsize=9.5, weight="bold", color=label.colour, va="bottom", **place)
    axes.text(edge, height, shorten(printable(label.name)), fontsize=8.5, color="#555555", va="top", **place)
    x, y = low + corner * (high - low), bottom + height * (top - bottom)
    axes.plot([x, label.point[0]], [y, label.point[1]], color=label.leader, linewidth=0.7, alpha=0.6, zorder=1.5)
