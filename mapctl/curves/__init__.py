"""Making curves: built-in shapes, points, CSV and SVG files. `Curve` itself is in `mapctl.curves.curve`."""

import os
from importlib import import_module
from os import PathLike
from pathlib import Path

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl.curves import csv_file
from mapctl.curves.curve import Curve
from mapctl.curves.polyline import build_dense_polyline
from mapctl.curves.shapes import SHAPES, parse_shape, sample_shape
from mapctl.errors import FileFormatError, RequestError

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
        svg_file = import_module("mapctl.curves.svg_file")  # its parser is slow to import
        points = svg_file.read_svg(path, metres_per_unit or svg_file.SVG_METRES_PER_UNIT)
    else:
        points = csv_file.read_csv(path) * (metres_per_unit or 1.0)
    try:
        return from_points(points)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error
