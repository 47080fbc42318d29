"""Built-in curves. Each starts at the origin; all but the wave set off along +Z, as the rest pose faces."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from mapctl.curves.polyline import MAX_POINTS, SPACING
from mapctl.errors import RequestError

MIN_SIZE, MAX_SIZE = 0.01, 10_000.0
"""Least and greatest radius, length or amplitude, metres."""


@dataclass(frozen=True)
class Shape:
    """Specification of a built-in curve."""

    sizes: tuple[str, ...]
    """Names of its sizes, in the order in which text gives them (joined by `x`); metres."""
    points: Callable[..., ndarray]
    """Sizes to points (n, 2), metres."""
    closed: bool
    """Whether it ends where it starts."""
    example: str
    """Example, as typed."""


def _join_circular_arcs(*arcs: tuple[float, float]) -> ndarray:
    """Join circular arcs (signed radius, left positive; angle) smoothly, from the origin along +Z."""
    place, heading, pieces = np.zeros(2), 0.0, [np.zeros((1, 2))]
    for radius, angle in arcs:
        # At least one vertex a degree, so that a tiny circle is round as well.
        count = min(math.ceil(max(abs(radius) * angle / SPACING, math.degrees(angle))), MAX_POINTS // 2)
        turned = heading + np.sign(radius) * np.linspace(0, angle, count + 1)[1:]
        across = radius * np.stack([np.cos(heading) - np.cos(turned), np.sin(turned) - np.sin(heading)], axis=1)
        pieces.append(place + across)
        place, heading = pieces[-1][-1], turned[-1]
    return np.concatenate(pieces)


def _circle(radius: float) -> ndarray:
    return _join_circular_arcs((radius, 2 * math.pi))


def _figure8(radius: float) -> ndarray:
    return _join_circular_arcs((radius, 2 * math.pi), (-radius, 2 * math.pi))


def _s(length: float) -> ndarray:
    return _join_circular_arcs((length / 4, math.pi), (-length / 4, math.pi))


def _line(length: float) -> ndarray:
    z = np.linspace(0, length, min(math.ceil(length / SPACING), MAX_POINTS) + 1)
    return np.stack([np.zeros_like(z), z], axis=1)


def _wave(amplitude: float, length: float) -> ndarray:
    travelled = length + 4 * amplitude  # an upper bound of its arc length
    count = min(math.ceil(max(travelled / SPACING, 360)), MAX_POINTS)
    z = np.linspace(0, length, count + 1)
    return np.stack([amplitude * np.sin(2 * math.pi * z / length), z], axis=1)


SHAPES: Mapping[str, Shape] = {
    "circle": Shape(("radius",), _circle, True, "circle:4"),
    "figure8": Shape(("radius",), _figure8, True, "figure8:2"),
    "s": Shape(("length",), _s, False, "s:6"),
    "line": Shape(("length",), _line, False, "line:10"),
    "wave": Shape(("amplitude", "length"), _wave, False, "wave:1x8"),
}
SHAPE_EXAMPLES = ", ".join(shape.example for shape in SHAPES.values())
"""Examples of what may be typed, for messages."""


def sample_shape(name: str, sizes: Mapping[str, float]) -> ndarray:
    """Sample points of a built-in curve. RequestError for a size that is not from 1 cm to 10 km."""
    for size, value in sizes.items():
        if not MIN_SIZE <= value <= MAX_SIZE:
            raise RequestError(f"{name}: {size} must be {MIN_SIZE:g} to {MAX_SIZE:g} m, got {value:g}")
    points = SHAPES[name].points(**sizes)
    if SHAPES[name].closed:
        points[-1] = points[0]  # exactly
    return points


def parse_shape(text: str) -> tuple[str, dict[str, float]]:
    """Name and sizes of a shape as typed: `wave:1x8`. RequestError says what may be typed."""
    name, _, numbers = text.partition(":")
    shape = SHAPES.get(name.strip().lower())
    if shape is None:
        raise RequestError(f"unknown curve {text!r}: expected {SHAPE_EXAMPLES}, or a CSV or SVG file")
    words = numbers.lower().split("x")
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != len(shape.sizes):
        form = f"{name}:{'x'.join(size.upper() for size in shape.sizes)}"
        raise RequestError(f"cannot read the curve {text!r}: expected {form} in metres, as {shape.example}")
    return name.strip().lower(), dict(zip(shape.sizes, values, strict=True))
