"""Stairs along a path: treads that are shorter than a step are walked slowly, one a step."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch

from controllers.shots.trajectory import Trajectory
from mapctl import rotations
from mapctl.curves import Curve
from mapctl.ground import Ground
from mapctl.intent.path import SpeedProfile, limit_speeds
from mapctl.numerics.intervals import true_intervals
from mapctl.terms import RootVelocity, StepLength, Term

_STEP_SECONDS = 0.5  # of a step of slow walks, whatever its length: `mapctl follow line:8 --speed 0.6` to 0.9
_DEEPEST = 0.6  # metres of a tread that is taken in one step
_BEFORE = 0.6  # metres before stairs, and after them, that are walked as slowly
_EDGE_HEIGHT = 0.05  # metres of an edge of stairs
_FACING, _STEP_SIGMA = 0.2, 0.03  # radians and metres by which hips and steps on stairs differ from path and treads
_GRID = 0.01  # metres of arc


@dataclass(frozen=True)
class Stairs:
    """Treads of a path that are shorter than a step, and how they are walked: slowly, a step a tread."""

    treads: tuple[tuple[float, float], ...] = ()
    """Arcs of the edges before each and after it, metres."""

    @staticmethod
    def find(curve: Curve, ground: Ground | None) -> "Stairs":
        """Find the treads along a path over a ground; none without one."""
        if ground is None:
            return Stairs()
        arcs = torch.linspace(0, curve.length, max(2, round(curve.length / _GRID) + 1), dtype=torch.float64)
        rises = ground.height(curve.ground_point(arcs)).diff().abs() > _EDGE_HEIGHT
        edges = [float(arcs[start]) for _, start, _ in true_intervals(rises[:, None])]
        return Stairs(tuple((one, other) for one, other in pairwise(edges) if other - one < _DEEPEST))

    def slow(self, profile: SpeedProfile, curve: Curve, slowest: float) -> SpeedProfile:
        """Lower speeds, m/s, so that a step is one tread long; to `slowest` at most, m/s."""
        limits = [
            (one - _BEFORE, other + _BEFORE, max(slowest, (other - one) / _STEP_SECONDS)) for one, other in self.treads
        ]
        return limit_speeds(profile, curve, limits)

    def terms(self, trajectory: Trajectory, first: int, frames: int) -> tuple[Term, ...]:
        """Return the terms of a window from frame `first` on: on treads steps are as long as these, and hips face along
        the path, from which slow walks turn them."""
        if not self.treads:
            return ()
        arcs = trajectory.arcs[torch.arange(first, first + frames).clamp(max=len(trajectory.arcs) - 1)]
        found = torch.tensor([(one, other) for one, other in self.treads], dtype=torch.float64).reshape(-1, 1, 2)
        on = ((arcs > found[..., 0] - _BEFORE) & (arcs < found[..., 1] + _BEFORE)).any(dim=0)
        if not bool(on.any()):
            return ()
        still, facing = torch.zeros(len(arcs), 2), rotations.unwrap_angle(trajectory.curve.heading(arcs))
        face = RootVelocity(still, still[:0], facing, sigma_speed=math.inf, sigma_facing=_FACING, name="facing")
        if float(on.double().mean()) < 0.5:
            return (face,)
        return face, StepLength(sum(other - one for one, other in self.treads) / len(self.treads), sigma=_STEP_SIGMA)
