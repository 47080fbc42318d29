"""Curves by shape, points, CSV or SVG file. `Curve` itself is in `mapctl.curves.curve`."""

import math
import os
import re
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
from mapctl.numerics import gaussian

_MIN_SIZE, _MAX_SIZE = 0.01, 10_000.0  # metres of a radius, length or amplitude
_SPLINE_SPACING = 0.02  # metres between the points that a spline is drawn with
_FILE_ENDINGS = (".csv", ".tsv", ".txt", ".svg")


def circle(*, radius: float) -> Curve:
    """Return a circle to the left of its start, the origin, heading +Z; radius in metres (0.01 to 10,000)."""
    _check_sizes("circle", radius=radius)
    return _join_arcs((radius, 2 * math.pi), closed=True)


def figure8(*, radius: float) -> Curve:
    """Return two circles that touch at the origin, the left one first, both along +Z there; radius in metres."""
    _check_sizes("figure8", radius=radius)
    return _join_arcs((radius, 2 * math.pi), (-radius, 2 * math.pi), closed=True)


def s(*, length: float) -> Curve:
    """Return an S: a half circle to the left, then one to the right; `length` metres from end to end, along +X."""
    _check_sizes("s", length=length)
    return _join_arcs((length / 4, math.pi), (-length / 4, math.pi), closed=False)


def line(*, length: float) -> Curve:
    """Return a straight line along +Z; length in metres."""
    _check_sizes("line", length=length)
    z = np.linspace(0, length, min(math.ceil(length / SPACING), MAX_POINTS) + 1)
    return Curve(torch.from_numpy(np.stack([np.zeros_like(z), z], axis=1)))


def wave(*, amplitude: float, length: float) -> Curve:
    """Return one period of a sine along +Z, first to the left: `amplitude` (half of peak to peak) and `length`
    in metres."""
    _check_sizes("wave", amplitude=amplitude, length=length)
    longest = length + 4 * amplitude  # an upper bound of its arc length
    z = np.linspace(0, length, min(math.ceil(max(longest / SPACING, 360)), MAX_POINTS) + 1)
    return Curve(torch.from_numpy(np.stack([amplitude * np.sin(2 * math.pi * z / length), z], axis=1)))


_SHAPES = {
    "circle": (circle, ("radius",), "circle:4"),
    "figure8": (figure8, ("radius",), "figure8:2"),
    "s": (s, ("length",), "s:6"),
    "line": (line, ("length",), "line:10"),
    "wave": (wave, ("amplitude", "length"), "wave:1x8"),
}  # name: function, sizes in the order in which text gives them (joined by `x`), example


def _check_sizes(shape: str, **sizes: float) -> None:
    for name, value in sizes.items():
        if not _MIN_SIZE <= value <= _MAX_SIZE:
            raise RequestError(f"{shape}: {name} must be {_MIN_SIZE:g} to {_MAX_SIZE:g} m, got {value:g}")


def _join_arcs(*arcs: tuple[float, float], closed: bool) -> Curve:
    """Join circular arcs (signed radius, left positive; angle) smoothly, from the origin along +Z."""
    position, heading, pieces = np.zeros(2), 0.0, [np.zeros((1, 2))]
    for radius, angle in arcs:
        # At least one vertex a degree, so that a tiny circle is round as well.
        count = min(math.ceil(max(abs(radius) * angle / SPACING, math.degrees(angle))), MAX_POINTS // 2)
        turned = heading + np.sign(radius) * np.linspace(0, angle, count + 1)[1:]
        across = radius * np.stack([np.cos(heading) - np.cos(turned), np.sin(turned) - np.sin(heading)], axis=1)
        pieces.append(position + across)
        position, heading = pieces[-1][-1], turned[-1]
    points = np.concatenate(pieces)
    if closed:
        points[-1] = points[0]  # exactly
    return Curve(torch.from_numpy(points), closed)


def _parse_shape(text: str) -> Curve:
    """Return the curve of a shape as typed: `wave:1x8`. RequestError states what may be typed."""
    name, _, numbers = text.partition(":")
    if name.strip().lower() not in _SHAPES:
        examples = ", ".join(example for _, _, example in _SHAPES.values())
        raise RequestError(f"unknown curve {text!r}: expected {examples}, or a CSV or SVG file")
    shape, sizes, example = _SHAPES[name.strip().lower()]
    try:
        values = dict(zip(sizes, map(float, numbers.lower().split("x")), strict=True))
    except ValueError:
        form = f"{name}:{'x'.join(size.upper() for size in sizes)}"
        raise RequestError(f"cannot read the curve {text!r}: expected {form} in metres, as {example}") from None
    return shape(**values)


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


def read(
    source: str | PathLike[str], *, metres_per_unit: float | None = None, folder: str | PathLike[str] = ""
) -> Curve:
    """Read the curve that a shape (`circle:4`, `wave:1x8`), a CSV file or an SVG file (by its ending) describes, or one
    path of an SVG file, by id, Inkscape's label or number (`drawing.svg#walk`, `drawing.svg#2`).

    `metres_per_unit` scales a file's numbers; by default a CSV is in metres and 100 SVG units are a metre. Files are
    relative to `folder`. RequestError for shapes and scales that cannot be; FileFormatError, with its line, for files.
    """
    text = os.fspath(source)
    if metres_per_unit is not None and not 1e-9 <= metres_per_unit <= 1e9:
        raise RequestError(f"metres per unit must be a positive number, got {metres_per_unit:g}")
    drawing = re.fullmatch(r"(.*?\.svg)#(.*)", text, re.IGNORECASE | re.DOTALL)
    file, name = drawing.groups() if drawing else (text, None)
    path = os.path.join(folder, file)  # noqa: PTH118
    is_path = any(mark in file for mark in (os.sep, os.altsep) if mark)
    if Path(file).suffix.lower() in _FILE_ENDINGS or is_path or (file and ":" not in file and Path(path).exists()):
        return _read_file(path, metres_per_unit, name)
    if metres_per_unit is not None:
        raise RequestError(f"metres per unit is for files; the curve {text!r} is in metres")
    return _parse_shape(text)


def _read_file(path: str, metres_per_unit: float | None, name: str | None) -> Curve:
    if path.lower().endswith(".svg"):
        points = files.read_svg(path, metres_per_unit or files.SVG_METRES_PER_UNIT, name)
    else:
        points = files.read_csv(path) * (metres_per_unit or 1.0)
    try:
        return from_points(points)
    except RequestError as error:
        raise FileFormatError(path, str(error)) from error


_AVERAGED_SPACING = 0.02  # metres between the points that are averaged
_USUAL = 0.2  # metres of arc, sigma: less than half a step, over which no hips turn to and fro
_FINE, _LONGER, _OFF, _MOVED = 0.05, 1.05, 0.002, 0.02
"""A path jitters that is 5 % longer than its average over 5 cm, and 2 mm off it (median): wide curves are not longer
at that scale, corners are off it in few points. One moved by more than 2 cm (median) by smoothing is a tight curve."""


def smooth_path(curve: Curve, metres: float | None = None) -> tuple[Curve, str | None]:
    """Smooth a path by a Gaussian with a standard deviation of so many metres of arc; also return a note if it did.

    None smooths a path that jitters, by 20 cm. The ends of an open path stay.
    """
    if metres == 0:
        return curve, None
    if metres is None:
        points, fine = _average(curve, _FINE)
        if curve.length < _LONGER * _measure_length(fine) or float((fine - points).norm(dim=-1).median()) < _OFF:
            return curve, None
    sigma = _USUAL if metres is None else metres
    points, smooth = _average(curve, sigma)
    moved, length = (smooth - points).norm(dim=-1), _measure_length(smooth)
    if metres is None and float(moved.median()) > _MOVED:
        return curve, None
    note = (
        f"the path was smoothed over {100 * sigma:.0f} cm and moved by {100 * float(moved.max()):.1f} cm at most; "
        f"it is {length:.1f} m long, was {curve.length:.1f} m"
    )
    return from_points(smooth[:-1] if curve.closed else smooth, closed=curve.closed), note


def _average(curve: Curve, sigma: float) -> tuple[Float[Tensor, "points dims"], Float[Tensor, "points dims"]]:
    """Return points of a curve at even arcs, and their average over a sigma of arc, metres."""
    count = max(8, round(curve.length / _AVERAGED_SPACING) + 1)
    points = curve.point(torch.linspace(0, curve.length, count, dtype=torch.float64))
    width = sigma * (count - 1) / curve.length
    beside = min(count - 1, max(1, round(3 * width)))
    if curve.closed:
        before, after = points[-beside - 1 : -1], points[1 : beside + 1]
    else:  # mirrored through the ends, which therefore stay
        before = 2 * points[:1] - points[1 : beside + 1].flip(0)
        after = 2 * points[-1:] - points[-beside - 1 : -1].flip(0)
    smooth = gaussian.smooth(torch.cat([before, points, after]), width)
    return points, smooth[beside : beside + count]


def _measure_length(points: Float[Tensor, "points dims"]) -> float:
    return float(torch.diff(points, dim=0).norm(dim=-1).sum())
