"""Paths as people draw them: the jitter of a hand or a tracker is smoothed to what hips can follow."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import curves
from mapctl.curves.curve import Curve
from mapctl.numerics import gaussian

_SPACING = 0.02  # metres between the points that are averaged
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
    return curves.from_points(smooth[:-1] if curve.closed else smooth, closed=curve.closed), note


def _average(curve: Curve, sigma: float) -> tuple[Float[Tensor, "points dims"], Float[Tensor, "points dims"]]:
    """Return points of a curve at even arcs, and their average over a sigma of arc, metres."""
    count = max(8, round(curve.length / _SPACING) + 1)
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
