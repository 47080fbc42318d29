"""Benchmark of corners: how far a walk leaves them, how slow it becomes, and how hard a toe is accelerated."""

import math
from collections.abc import Callable

import numpy as np
import torch

from controllers.benchmarks.shared.tables import Row
from controllers.shots.request import ShotRequest
from controllers.shots.shot import solve_shot
from mapctl import curves
from mapctl.curves import Curve
from mapctl.features import PRIOR_FPS
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES

_TOES = list(CANONICAL.indices(TOES))
_LEG = 2.4  # metres before a corner and after it
_ASIDE = 0.5  # metres between the two ways of a hairpin
_MOST_BEHIND = 2.0  # metres of arc within which hips are looked for on the curve
_SPEED_FRAMES = 15  # over which a speed is measured: hips are faster and slower within a step


def _turn(degrees: float) -> Curve:
    angle = math.radians(degrees)
    return _connect((0, 0), (0, _LEG), (_LEG * math.sin(angle), _LEG * (1 + math.cos(angle))))


def _connect(*points: tuple[float, float]) -> Curve:
    return curves.from_points(np.array(points, dtype=np.float64), closed=False)


COURSES: dict[str, Callable[[], Curve]] = {
    "circle of 2 m": lambda: curves.circle(radius=2.0),
    "45 degrees": lambda: _turn(45),
    "90 degrees": lambda: _turn(90),
    "135 degrees": lambda: _turn(135),
    "square": lambda: _connect((0, 0), (0, _LEG), (_LEG, _LEG), (_LEG, 0), (0, 0)),
    "hairpin": lambda: _connect((0, 0), (0, _LEG), (_ASIDE, _LEG), (_ASIDE, 0)),
    "reversal": lambda: _turn(180),
}
"""Ways to walk by name, from left to right; the first is what the others are compared with."""


def benchmark_corners(
    prior: Density, inbetweener: Inbetweener, *, seeds: int = 2, progress: Callable[[int, int], None] | None = None
) -> list[Row]:
    """Walk each course with several seeds, at the usual speed; a row for each: the hips' largest distance from the
    curve (mean of the seeds, and the worst), that from where they were to be at that time, the lowest speed over half a
    second, and the largest acceleration of a toe, also as a multiple of a circle's."""
    rows, usual = [], math.nan
    for number, (name, build) in enumerate(COURSES.items()):
        found = [_measure_walk(prior, inbetweener, build(), seed) for seed in range(seeds)]
        left, behind, slowest, accelerations = (list(column) for column in zip(*found, strict=True))
        usual = max(accelerations) if number == 0 else usual
        rows.append(
            {
                "course": name,
                "shots": seeds,
                "left_cm": sum(left) / seeds,
                "left_worst_cm": max(left),
                "behind_worst_cm": max(behind),
                "slowest_m_s": min(slowest),
                "toe_acceleration_m_s2": max(accelerations),
                "of_a_circle_s": max(accelerations) / usual,
            }
        )
        if progress is not None:
            progress(number + 1, len(COURSES))
    return rows


def _measure_walk(prior: Density, inbetweener: Inbetweener, curve: Curve, seed: int) -> tuple[float, ...]:
    """Measure the largest distances from the curve and from where the hips were to be, cm, the lowest speed, m/s, and a
    toe's largest acceleration, m/s^2."""
    done = solve_shot(prior, inbetweener, ShotRequest(curve), generator=torch.Generator().manual_seed(seed))
    hips, way = done.motion.root_position[:, ::2], done.way
    near = way.curve.nearest(hips, way.arcs, reach=_MOST_BEHIND)
    off, behind = ((hips - way.curve.ground_point(arcs)).norm(dim=-1) for arcs in (near, way.arcs))
    travelled = (hips[_SPEED_FRAMES:] - hips[:-_SPEED_FRAMES]).norm(dim=-1) * PRIOR_FPS / _SPEED_FRAMES
    toes = done.motion.joint_positions()[:, _TOES]
    accelerations = torch.diff(toes, n=2, dim=0).norm(dim=-1) * PRIOR_FPS**2
    return 100 * float(off.max()), 100 * float(behind.max()), float(travelled.min()), float(accelerations.max())
