"""Making curves: built-in shapes, points, CSV and SVG files. `Curve` itself is in `mapctl.curves.curve`."""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl.curves import files
from mapctl.curves.curve import MAX_POINTS, SPACING, Curve, build_dense_polyline
from mapctl.errors import FileFormatError, RequestError

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


_SPLINE_SPACING = 0.02  # metres between the points that a spline is drawn with
_FILE_ENDINGS = (".csv", ".tsv", ".txt", ".svg")


def from_points(points: Float[Tensor, "points dims"] | ndarray, *, closed: bool | None = None) -> Curve:
    """Build the curve through points (x, z) or (x, y, z) in metres: an array or tensor of shape (n, 2) or (n, 3).

    `closed` None closes it where its ends meet (within 1 mm, or half the points' usual spacing). RequestError for fewer
    than 2 distinct points, more than a million, values that are not finite, or lengths that are not 1 cm to 100 km.
    """
    return Curve(*build_dense_polyline(points, closed))


def through(points: Float[Tensor, "points dims"] | ndarray, *, closed: bool = False) -> Curve:
    """Build a smooth curve through a few points set by hand, a closed one from the last to the first again: a cubic
    spline over the square root of the chord length.

    That parameter (as in centripetal Catmull-Rom splines) keeps loops out where far and near points follow each other.
    Errors as of `from_points`, of which it is a finer case.
    """
    given = np.asarray(points, dtype=np.float64)
    if closed and len(given) > 2:
        given = np.concatenate([given, given[:1]])
    whole = from_points(given, closed=False)  # raises what is wrong with the points
    spans = np.sqrt(np.linalg.norm(np.diff(given, axis=0), axis=1))
    kept = np.r_[True, spans > 1e-3]
    is_loop = closed and int(kept.sum()) > 3
    if kept.sum() < 3 or (closed and not is_loop):
        return from_points(given, closed=closed)
    at = np.r_[0.0, np.cumsum(spans[kept[1:]])]
    fine = np.linspace(0.0, at[-1], max(2, round(whole.length / _SPLINE_SPACING)))
    knots = given[kept]
    if is_loop:
        knots[-1] = knots[0]  # exactly, as a periodic spline demands
    spline = scipy.interpolate.CubicSpline(at, knots, bc_type="periodic" if is_loop else "natural")
    return from_points(spline(fine), closed=is_loop)


def circle(*, radius: float) -> Curve:
    """Make a circle to the left of its start, the origin, heading +Z; radius in metres (0.01 to 10,000)."""
    return _build_shape("circle", {"radius": radius})


def figure8(*, radius: float) -> Curve:
    """Make two circles that touch at the origin, the left one first, both along +Z there; radius in metres."""
    return _build_shape("figure8", {"radius": radius})


def s(*, length: float) -> Curve:
    """Make an S: a half circle to the left, then one to the right; `length` metres from end to end, along +X."""
    return _build_shape("s", {"length": length})


def line(*, length: float) -> Curve:
    """Make a straight line along +Z; length in metres."""
    return _build_shape("line", {"length": length})


def wave(*, amplitude: float, length: float) -> Curve:
    """Make one period of a sine along +Z, first to the left: `amplitude` (half of peak to peak) and `length`
    in metres."""
    return _build_shape("wave", {"amplitude": amplitude, "length": length})


def _build_shape(name: str, sizes: dict[str, float]) -> Curve:
    return Curve(torch.from_numpy(sample_shape(name, sizes)), SHAPES[name].closed)


def read(source: str | PathLike[str], *, metres_per_unit: float | None = None) -> Curve:
    """Read the curve that a shape (`circle:4`, `wave:1x8`), a CSV file or an SVG file (by its ending) describes.

    `metres_per_unit` scales a file's numbers; by default a CSV is in metres and 100 SVG units are a metre. RequestError
    for shapes and scales that cannot be; FileFormatError, with its line, for files.
    """
    text = os.fspath(source)
    if metres_per_unit is not None and not 1e-9 <= metres_per_unit <= 1e9:
        raise RequestError(f"metres per unit must be a positive number, got {metres_per_unit:g}")
    if Path(text).suffix.lower() in _FILE_ENDINGS or (text and ":" not in text and Path(text).exists()):
        return _read_file(text, metres_per_unit)
    if metres_per_unit is not None:
        raise RequestError(f"metres per unit is for files; the curve {text!r} is in metres")
    return _build_shape(*parse_shape(text))


def _read_file(path: str, metres_per_unit: float | None) -> Curve:
    if path.lower().endswith(".svg"):
        points = files.read_svg(path, metres_per_unit or files.SVG_METRES_PER_UNIT)
    else:
        points = files.read_csv(path) * (metres_per_unit or 1.0)
    try:
        return from_points(points)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error
