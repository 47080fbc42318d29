"""Arcs of a walker along a curve, from the whole walk: dynamic programming over arcs, as in map matching.

The nearest position alone jumps to another branch wherever a curve comes near itself, crosses itself or returns along
itself. Here the arc goes on without a jump, and forward unless going back explains the walk clearly better: of all
such paths along the curve the one with the least squared distance is found (Viterbi 1967; with a hidden Markov model's
states on the road, Newson and Krumm 2009). The walk is taken by its own length, so neither speed nor rate matter.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from mapctl.curves.curve import Curve

_STEP = 0.02  # metres between neighbouring arcs, and between the walk's positions that are looked at
_MAX_ARCS = 10_000  # positions and arcs: of long walks both lie farther apart
_MAX_PACE_RATIO = 3  # arc per metre walked, at most: bends and corners may be cut
_BACKWARD_COST = 0.3**2  # square metres: going back must explain the walk better than going on or staying by 0.3 m
_PRUNING_MARGIN = 3.0 / _STEP  # squared metres, summed: arcs that explain the walk so much worse are dropped
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

    def within(self, first: int, stop: int) -> tuple[int, int]:
        """Clip a range of numbers to those that exist."""
        return (first, stop) if self.closed else (max(first, self.first), min(stop, self.first + len(self.positions)))

    def squared_distances(self, point: Float[ndarray, " dims"], first: int, stop: int) -> Float[ndarray, " arcs"]:
        """Return squared distances from a position to the arcs first to stop."""
        numbers = np.arange(first - self.first, stop - self.first)
        near = self.positions.take(numbers, axis=0, mode="wrap") if self.closed else self.positions[numbers]
        return np.square(near - point).sum(-1)


def _find_best_arcs(
    grid: _ArcGrid, positions: Float[ndarray, "count dims"], first: int, stop: int
) -> Float[ndarray, " count"]:
    """Find the numbers of the arcs at the walk's positions; the first is one of first to stop."""
    most = _MAX_PACE_RATIO + 1
    # Columns: from how many arcs ahead (going back) to how many behind (going on); of equal costs the slowest.
    moves = np.arange(most, -most - 1, -1)
    price = np.where(moves > 0, _BACKWARD_COST * moves, 0.0) + 1e-9 * abs(moves)
    first, stop = grid.within(first, stop)
    cost = grid.squared_distances(positions[0], first, stop)
    cameby: list[tuple[int, ndarray]] = []
    for position in positions[1:]:
        alive = np.flatnonzero(cost <= cost.min() + _PRUNING_MARGIN)  # arcs that may still turn out best
        first, stop, cost = first + int(alive[0]), first + int(alive[-1]) + 1, cost[alive[0] : alive[-1] + 1]
        low, high = grid.within(first - most, stop + most)
        padded = np.pad(cost, 2 * most, constant_values=np.inf)[low - first + most : high - first + 3 * most]
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * most + 1)[:, ::-1] + price
        picked = around.argmin(-1)
        cost = np.take_along_axis(around, picked[:, None], axis=-1)[:, 0]
        cost = cost + grid.squared_distances(position, low, high)
        cameby.append((low, moves[picked].astype(np.int8)))
        first, stop = low, high
    found = [first + int(cost.argmin())]
    for low, back in reversed(cameby):
        found.append(found[-1] + int(back[found[-1] - low]))
    return np.array(found[::-1], dtype=float)


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
