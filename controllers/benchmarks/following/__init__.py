"""Benchmark of following: densities with the solver, and motion matching, along the same curves."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

from controllers.benchmarks.following.motion_matching import MotionDatabase, follow_by_matching
from controllers.benchmarks.shared.tables import Row, average_rows
from controllers.benchmarks.solver import follow_to_end
from controllers.following.follow import FollowSettings
from mapctl import curves
from mapctl.curves import Curve
from mapctl.editing import plant_feet
from mapctl.metrics import measure
from mapctl.metrics.worst_frame import measure_peaks
from mapctl.motion import Motion
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, TOES

_MEASURES = (
    "path_error_mean_cm",
    "path_error_p95_cm",
    "path_error_max_cm",
    "sway_cm",
    "contact_speed_cm_s",
    "skate_ratio",
    "jitter_m_s3",
    "speed_m_s",
)
_WORST = ("path_error_max_cm", "step_cm", "acceleration_m_s2")
_ENDS = list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))

Walker = Callable[[Curve, float, float, int], tuple[Motion, float]]
"""A curve, seconds, m/s and a seed to a motion and the milliseconds that a frame took."""


@dataclass(frozen=True)
class FollowBenchmarkSettings:
    """Size of the benchmark."""

    courses: tuple[tuple[str, float], ...] = (
        ("line:8", 1.2),
        ("circle:4", 1.2),
        ("figure8:2", 1.2),
        ("s:8", 1.2),
        ("wave:1x8", 1.2),
        ("circle:4", 2.4),
    )
    """Curves, each walked once, and speeds, m/s."""
    seeds: int = 3
    """Walks of each curve."""


def benchmark_follow(
    densities: Mapping[str, Density],
    database: MotionDatabase | None = None,
    settings: FollowBenchmarkSettings | None = None,
) -> list[Row]:
    """Measure a row for each curve and method: means over seeds, the largest over all of them of what is largest (path
    error, step and acceleration of hands and toes beside the hips).

    Motion matching is measured as it is, and with feet that are planted afterwards.
    """
    settings = settings or FollowBenchmarkSettings()
    walkers: dict[str, Walker] = {name: _by_density(density) for name, density in densities.items()}
    if database is not None:
        walkers |= {"motion matching": _by_matching(database), "motion matching, planted": _by_planting(database)}
    return [
        {"curve": course, "speed": speed, "method": name, **_measure_walks(walker, course, speed, settings.seeds)}
        for course, speed in settings.courses
        for name, walker in walkers.items()
    ]


def _measure_walks(walker: Walker, course: str, speed: float, seeds: int) -> Row:
    curve, rows = curves.read(course), []
    for seed in range(seeds):
        motion, cost = walker(curve, curve.length / speed, speed, seed)
        found, positions = measure(motion, curve), motion.joint_positions()
        peaks = measure_peaks(positions[:, _ENDS], positions[:, 0], float(motion.fps))
        worst = {"step_cm": 100 * peaks.step, "acceleration_m_s2": peaks.acceleration}
        rows.append({**{name: found[name] for name in _MEASURES}, **worst, "ms_per_frame": cost})
    return average_rows(rows, worst=_WORST)


def _by_density(density: Density) -> Walker:
    def walk(curve: Curve, seconds: float, speed: float, seed: int) -> tuple[Motion, float]:
        began = time.process_time()
        motion = follow_to_end(density, curve, seconds, seed, FollowSettings(), speed=speed).motion
        return motion, 1000 * (time.process_time() - began) / motion.num_frames

    return walk


def _by_matching(database: MotionDatabase) -> Walker:
    def walk(curve: Curve, seconds: float, speed: float, seed: int) -> tuple[Motion, float]:
        generator = torch.Generator().manual_seed(seed)
        return follow_by_matching(database, curve, seconds=seconds, speed=speed, generator=generator)

    return walk


def _by_planting(database: MotionDatabase) -> Walker:
    walk_as_is = _by_matching(database)

    def walk(curve: Curve, seconds: float, speed: float, seed: int) -> tuple[Motion, float]:
        motion, cost = walk_as_is(curve, seconds, speed, seed)
        began = time.process_time()
        planted = plant_feet(motion)
        return planted, cost + 1000 * (time.process_time() - began) / motion.num_frames

    return walk
