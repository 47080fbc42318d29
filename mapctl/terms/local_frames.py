"""Local frames of curves: the positions and directions of `Curve.nearest`, `Curve.point`, `Curve.tangent` and
`Curve.left`, which are their specification, in one compiled pass. Arithmetic is float64 throughout.
"""

# pyright: basic
# (numba infers the types)

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve
from mapctl.numerics.jit import make_jit_decorators

entry, inner = make_jit_decorators("contract", "nsz")

_ARC_LIMIT = 1e9  # metres; beyond it, and for arcs that are no numbers, there is no segment to count


@inner
def find_segment(curve, arc):
    """Find the segment of an arc, counted on through the laps of a closed curve, and the lap's first arc."""
    count, lap = len(curve.directions), 0.0
    if curve.closed:
        lap = math.floor(arc / curve.length)
    within, first, beyond = arc - lap * curve.length, 0, count
    while beyond - first > 1:
        middle = (first + beyond) // 2
        if curve.knots[middle] <= within:
            first = middle
        else:
            beyond = middle
    return np.int64(lap) * count + first


@inner
def evaluate_position(curve, arc, position):
    """Evaluate the position on the curve at an arc: straight on beyond open ends."""
    segment = find_segment(curve, arc)
    lap, index = segment // len(curve.directions), segment % len(curve.directions)
    along = arc - lap * curve.length - curve.knots[index]
    for k in range(len(position)):
        position[k] = curve.corners[index, k] + along * curve.directions[index, k]


@inner
def find_nearest_arc(curve, point, around, reach):
    """Find the arc of the position nearest to a point on the segments within reach of `around`; NaN if the point is."""
    best, found, count = math.inf, math.nan, len(curve.directions)
    for segment in range(find_segment(curve, around - reach), find_segment(curve, around + reach) + 1):
        lap, index = segment // count, segment % count
        along, apart = 0.0, 0.0
        for k in range(len(point)):
            along += (point[k] - curve.corners[index, k]) * curve.directions[index, k]
        if curve.closed or index > 0:  # the pieces beyond open ends have no end
            along = max(along, 0.0)
        if curve.closed or index < count - 1:
            along = min(along, curve.knots[index + 1] - curve.knots[index])
        for k in range(len(point)):
            off = curve.corners[index, k] + along * curve.directions[index, k] - point[k]
            apart += off * off
        if apart < best:
            best, found = apart, lap * curve.length + curve.knots[index] + along
    return found


@inner
def evaluate_axes(curve, arc, ahead, behind, axes):
    """Evaluate rows: left on the ground, forward (a chord's direction), in space upward but for what lies forward.

    `ahead` and `behind` (dims) are scratch.
    """
    last = len(ahead) - 1
    evaluate_position(curve, arc + curve.half_base, ahead)
    evaluate_position(curve, arc - curve.half_base, behind)
    length = 0.0
    for k in range(last + 1):
        ahead[k] -= behind[k]
        length += ahead[k] * ahead[k]
    length = math.sqrt(length)
    if length < 1e-6:  # where a curve turns back on itself the chord vanishes
        segment, length = find_segment(curve, arc) % len(curve.directions), 0.0
        for k in range(last + 1):
            ahead[k] = curve.directions[segment, k]
            length += ahead[k] * ahead[k]
        length = math.sqrt(length)
    for k in range(last + 1):
        ahead[k] /= length
    ground = max(math.sqrt(ahead[0] * ahead[0] + ahead[last] * ahead[last]), 1e-9)
    for k in range(last + 1):
        axes[0, k], axes[1, k] = 0.0, ahead[k]
    axes[0, 0], axes[0, last] = ahead[last] / ground, -ahead[0] / ground
    if last == 2:
        for k in range(3):
            axes[2, k] = -ahead[1] * ahead[k]
        axes[2, 1] += 1.0


@entry
def fill_local_frames(curve, points, around, reach, positions, axes, straightened):
    """Fill local frames of points (batch, frames, dims) near arcs `around` (frames); see `LocalFrame`."""
    if curve.closed:
        reach = min(reach, 0.5 * curve.length)  # a lap has every position once
    dims = points.shape[2]
    position, frame, scratch = np.empty(dims), np.empty((dims, dims)), np.empty((2, dims))
    for b in range(len(points)):
        for t in range(len(around)):
            arc = math.nan
            if abs(around[t]) < _ARC_LIMIT:
                arc = find_nearest_arc(curve, points[b, t], around[t], reach)
                arc = arc if math.isfinite(arc) else around[t]
                evaluate_position(curve, arc, position)
                evaluate_axes(curve, arc, scratch[0], scratch[1], frame)
            for k in range(dims):
                known = math.isfinite(arc)
                positions[b, t, k] = position[k] if known else math.nan
                straightened[b, t, k] = position[k] + (around[t] - arc) * frame[1, k] if known else math.nan
                for row in range(dims):
                    axes[b, t, row, k] = frame[row, k] if known else math.nan


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """The curve near each point; constants, without gradient."""

    position: Float[Tensor, "batch frames dims"]
    """Nearest position on the curve, metres."""
    axes: Float[Tensor, "batch frames dims dims"]
    """Unit rows: left on the ground, forward; in space a third, upward less what of it lies along the slope."""
    tangent_extension: Float[Tensor, "batch frames dims"]
    """Position of the arc looked around if the curve went straight on from the nearest one, metres."""


class _CurveTables(NamedTuple):
    knots: np.ndarray
    corners: np.ndarray
    directions: np.ndarray
    closed: bool
    length: float
    half_base: float


def find_local_frames(
    curve: Curve, points: Float[Tensor, "batch frames dims"], around: Float[Tensor, " frames"], *, reach: float
) -> LocalFrame:
    """Find the nearest positions within `reach` metres of the arcs `around`; results have the points' dtype.

    Points have the curve's dimensions. Arcs that are not finite give NaN.
    """
    arcs = around.detach().double().contiguous().numpy()
    known = points.detach().contiguous()
    near = LocalFrame(torch.empty_like(known), known.new_empty(*known.shape, curve.dims), torch.empty_like(known))
    filled = (near.position.numpy(), near.axes.numpy(), near.tangent_extension.numpy())
    fill_local_frames(_build_tables(curve), known.numpy(), arcs, reach, *filled)
    return near


def _build_tables(curve: Curve) -> _CurveTables:
    knots, corners, directions = (table.numpy() for table in curve._tables)
    return _CurveTables(knots, corners, directions, curve.closed, curve.length, curve._half_base)
