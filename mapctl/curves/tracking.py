"""Arcs of a walker along a curve, from the whole walk: dynamic programming over arcs, as in map matching.

The nearest position alone jumps to another branch wherever a curve comes near itself, crosses itself or returns along
itself. Here the arc goes on without a jump, and forward unless going back explains the walk clearly better: of all
such paths along the curve the one with the least squared distance is found (Viterbi 1967; with a hidden Markov model's
states on the road, Newson and Krumm 2009). The walk is taken by its own length, so neither speed nor rate matter.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl.curves.curve import Curve

_STEP = 0.02  # metres between neighbouring arcs, and between the walk's positions that are looked at
_MAX_ARCS = 4_000  # positions and arcs: of long walks both lie farther apart
_MAX_PACE_RATIO = 3  # arc per metre walked, at most: bends and corners may be cut
_BACKWARD_COST = 0.3**2  # square metres: going back must explain the walk better than going on or staying by 0.3 m
_REFINED_STEP = 0.04  # metres between refined arcs
_TIE_BREAK = 0.01  # square metres per metre from the tracked arc: of two equally near arcs the one nearer to it wins


def track_arcs(
    curve: Curve, points_world: Float[Tensor, "frames axes"], *, start: float | None = None, reach: float = 0.5
) -> Float[Tensor, " frames"]:
    """Track the arcs of a walk, metres, not wrapped: without a jump, and forward unless the walk goes back.

    So the other leg of a hairpin, a crossing's other branch and a curve that touches itself are distinguished, and laps
    of a closed one counted; beyond open ends the curve goes on straight. Points are (x, y, z), or (x, z) for a curve on
    the ground. The first arc is searched within `reach` metres of `start`: by default of the curve's start if the walk
    begins within `reach` of it (where a figure-8 crosses, arcs are ambiguous), else anywhere on the curve. Every arc is
    the nearest within `reach` metres of the tracked one.
    """
    points = curve.to_curve_axes(points_world).detach().double()
    if start is None and bool((points[0] - curve.start).norm() <= reach):
        start = 0.0
    walked = torch.cat([points.new_zeros(1), points.diff(dim=0).norm(dim=-1).cumsum(0)])
    grid = _ArcGrid.of(curve, float(walked[-1]) + reach)
    count = 1 + math.ceil(float(walked[-1]) / grid.step)
    at = np.linspace(0, float(walked[-1]), count)
    positions = np.stack([np.interp(at, walked.numpy(), column) for column in points.numpy().T], axis=-1)
    if start is None:
        first, last = 0, grid.lap
    else:
        first, last = math.floor((start - reach) / grid.step), math.ceil((start + reach) / grid.step)
    arcs = np.interp(walked.numpy(), at, grid.step * _find_best_arcs(grid, positions, first, last + 1))
    return _refine_arcs(curve, points, torch.from_numpy(arcs), reach)


@dataclass(frozen=True, eq=False)
class _ArcGrid:
    """Evenly spaced arcs; number n lies n steps from the curve's start."""

    step: float
    """Arcs, metres."""
    positions: Float[ndarray, "arcs dims"]
    """Curve position at each arc, metres."""
    first: int
    """Number of the first arc; 0 on a closed curve, whose arcs go round."""
    lap: int
    """Number of the last arc on the curve."""
    closed: bool
    """Whether the numbers go round."""

    @staticmethod
    def of(curve: Curve, beyond: float) -> "_ArcGrid":
        """Space arcs over the whole curve, and `beyond` metres straight on from open ends."""
        step = max(_STEP, (curve.length + beyond) / _MAX_ARCS)
        lap = max(8, math.ceil(curve.length / step))
        step = curve.length / lap
        more = 0 if curve.closed else math.ceil(beyond / step) + 1
        numbers = torch.arange(-more, lap + more + (not curve.closed), dtype=torch.float64)
        return _ArcGrid(step, curve.point(numbers * step).numpy(), -more, lap, curve.closed)

    def squared_distances(self, point: Float[ndarray, " dims"]) -> Float[ndarray, " arcs"]:
        """Return squared distances from a position to all arcs."""
        return np.square(self.positions - point).sum(-1)


def _find_best_arcs(
    grid: _ArcGrid, positions: Float[ndarray, "count dims"], first: int, stop: int
) -> Float[ndarray, " count"]:
    """Find the numbers of the arcs at the walk's positions; the first is one of first to stop. They go on from lap to
    lap of a closed curve."""
    most = _MAX_PACE_RATIO + 1
    # Columns: from how many arcs ahead (going back) to how many behind (going on); of equal costs the slowest.
    moves = np.arange(most, -most - 1, -1)
    price = np.where(moves > 0, _BACKWARD_COST * moves, 0.0) + 1e-9 * abs(moves)
    allowed = np.arange(first, stop) - grid.first
    allowed = allowed % grid.lap if grid.closed else allowed[(allowed >= 0) & (allowed < len(grid.positions))]
    cost = np.full(len(grid.positions), np.inf)
    cost[allowed] = grid.squared_distances(positions[0])[allowed]
    beside: dict[str, Any] = {"mode": "wrap"} if grid.closed else {"constant_values": np.inf}
    came_by: list[ndarray] = []
    for position in positions[1:]:
        around = np.lib.stride_tricks.sliding_window_view(np.pad(cost, most, **beside), 2 * most + 1)[:, ::-1] + price
        picked = around.argmin(-1)
        cost = np.take_along_axis(around, picked[:, None], axis=-1)[:, 0] + grid.squared_distances(position)
        came_by.append(moves[picked].astype(np.int8))
    found = [int(cost.argmin())]
    for back in reversed(came_by):
        found.append(found[-1] + int(back[found[-1] % len(back)]))
    numbers = grid.first + np.array(found[::-1], dtype=float)
    laps = math.ceil((first - numbers[0]) / grid.lap) if grid.closed else 0
    return numbers + laps * grid.lap


def _refine_arcs(
    curve: Curve, points: Float[Tensor, "frames dims"], arcs: Float[Tensor, " frames"], reach: float
) -> Float[Tensor, " frames"]:
    """Find the nearest arcs on the branch that was found."""
    count = math.ceil(reach / _REFINED_STEP)
    room = torch.arange(-count, count + 1, dtype=torch.float64) * _REFINED_STEP
    found = []
    for some, around in zip(points.split(4096), arcs.split(4096), strict=True):  # keeps memory small
        tried = around[:, None] + room
        apart = (curve.point(tried) - some[:, None]).square().sum(-1) + _TIE_BREAK * room.abs()
        near = tried.gather(1, apart.argmin(-1, keepdim=True))[:, 0]
        found.append(curve.nearest(some, around=near, reach=_REFINED_STEP))
    return torch.cat(found)
