"""From points as drawn, coarse or dense, to a polyline about 1 cm fine; no smoothing, no cut corners."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl.errors import RequestError

SPACING = 0.01
"""Metres between the vertices of a curve, about."""
TANGENT_BASE = 0.05
"""Metres of the chord that gives a tangent: longer than the jitter of a drawing, shorter than a stride."""
MIN_LENGTH, MAX_LENGTH = 0.01, 100_000.0
"""Least and greatest length of a curve, metres."""
MAX_POINTS = 1_000_000
"""Largest number of points that a curve may be given with, and has."""

_COINCIDENT = 1e-6  # metres; nearer neighbours are one point
_CLOSED_GAP = 1e-3  # metres; ends nearer than this meet


def build_dense_polyline(
    points: ndarray | Tensor, closed: bool | None = None
) -> tuple[Float[Tensor, "dense dims"], bool]:
    """Build the polyline through `points` (n, 2 or 3; metres), vertices about 1 cm apart, and whether it is closed.

    Straight pieces are divided evenly; of points denser than 1 cm the one that bends the curve most is kept in each
    centimetre. Closed where `closed` says so, or by default where the ends lie within 1 mm, or half the points' usual
    spacing, of each other; a closed polyline repeats its first point at the end. Raises RequestError with the reason
    where points make no curve.
    """
    given = _check_points(points)
    distinct = given[np.r_[True, _span_lengths(given) > _COINCIDENT]]
    if len(distinct) < 2:
        raise RequestError("a curve needs at least 2 distinct points, got 1")
    closed = _ends_meet(distinct) if closed is None else closed
    if closed:
        distinct = _close_polyline(distinct)
    length = _span_lengths(distinct).sum()
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        raise RequestError(f"the curve is {length:.6g} m long, allowed are {MIN_LENGTH:g} to {MAX_LENGTH:g} m")
    spacing = max(SPACING, length / MAX_POINTS)
    return torch.from_numpy(_subdivide(_thin_points(distinct, spacing), spacing)), closed


def _check_points(points: ndarray | Tensor) -> Float[ndarray, "points dims"]:
    given = np.asarray(points, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] not in (2, 3):
        raise RequestError(f"a curve's points have the shape (n, 2) or (n, 3), got {given.shape}")
    if not 2 <= len(given) <= MAX_POINTS:
        raise RequestError(f"a curve needs 2 to {MAX_POINTS} points, got {len(given)}")
    wrong = ~(np.abs(given) <= MAX_LENGTH).all(axis=1)  # catches NaN as well
    if wrong.any():
        first = int(wrong.argmax())
        place = ", ".join(f"{value:g}" for value in given[first])
        raise RequestError(f"point {first} of the curve is ({place}), expected numbers up to {MAX_LENGTH:g} m")
    return given


def _span_lengths(points: ndarray) -> ndarray:
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def _ends_meet(points: ndarray) -> bool:
    gap = np.linalg.norm(points[-1] - points[0])
    return len(points) > 2 and bool(gap <= max(_CLOSED_GAP, 0.5 * np.median(_span_lengths(points))))


def _close_polyline(points: ndarray) -> ndarray:
    """Repeat the first point at the end, exactly."""
    if np.linalg.norm(points[-1] - points[0]) <= _CLOSED_GAP:
        points = points[:-1]
    return np.concatenate([points, points[:1]])


def _thin_points(points: ndarray, spacing: float) -> ndarray:
    """Keep both ends, and of the points in each piece of `spacing` metres the one farthest from its chord."""
    arcs = np.r_[0.0, np.cumsum(_span_lengths(points))]

    def place(at: ndarray) -> ndarray:
        return np.stack([np.interp(at, arcs, axis) for axis in points.T], axis=1)

    bend = np.linalg.norm(points - (place(arcs - spacing) + place(arcs + spacing)) / 2, axis=1)
    bend[[0, -1]] = np.inf
    # The last point has a piece of its own, or it might be dropped in favour of the first.
    piece = np.r_[(arcs[:-1] / spacing).astype(np.int64), np.iinfo(np.int64).max]
    order = np.lexsort((-bend, piece))
    best = order[np.r_[True, np.diff(piece[order]) > 0]]
    return points[np.sort(best)]


def _subdivide(points: ndarray, spacing: float) -> ndarray:
    """Cut every straight piece into equal parts of at most `spacing` metres."""
    parts = np.maximum(1, np.ceil(_span_lengths(points) / spacing - 1e-9)).astype(np.int64)
    piece = np.repeat(np.arange(len(parts)), parts)
    step = np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)
    inner = points[piece] + (step / parts[piece])[:, None] * np.diff(points, axis=0)[piece]
    return np.concatenate([inner, points[-1:]])
