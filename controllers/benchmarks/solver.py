"""Benchmark of the solver: milliseconds of an evaluation and of whole solves, as ratios within one run."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.common.initial_state import select_initial_state
from controllers.following.follow import FollowSettings, build_follow_terms, follow
from mapctl import curves
from mapctl.curves import Curve
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.intent.path import USUAL_SPEED
from mapctl.problem.context import WindowContext
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.objective import Objective
from mapctl.problem.solution import Outcome, Solution
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL
from mapctl.terms import Term


@dataclass(frozen=True)
class SpeedBenchmarkSettings:
    """Size of the benchmark."""

    repeats: int = 40
    """Number of timed evaluations; the fastest counts, since other work on the machine only adds."""
    particles: tuple[int, ...] = (1, 4, 16, 32)
    """Batch sizes."""
    lengths: tuple[float, ...] = (4.0, 8.0, 16.0)
    """Lengths of motion, seconds, to show that cost grows linearly."""
    seed: int = 0
    """Seed of initial states and samples."""


def benchmark_speed(
    prior: Density, reference: Density, settings: SpeedBenchmarkSettings = SpeedBenchmarkSettings()
) -> list[Row]:
    """Time energy and gradient of one window on the fast path and on the torch `reference`, then whole solves."""
    rows = [_benchmark_evaluation(prior, reference, count, settings) for count in settings.particles]
    return rows + [_benchmark_follow(prior, seconds, settings) for seconds in settings.lengths]


def _benchmark_evaluation(prior: Density, reference: Density, count: int, settings: SpeedBenchmarkSettings) -> Row:
    fast, slow = (_time_evaluation(p, count, settings) for p in (prior, reference))
    return {
        "what": f"energy and gradient, 34 frames, {count} candidates",
        "fast_ms": fast,
        "reference_ms": slow,
        "times_faster": slow / fast,
        "fast_ms_per_candidate": fast / count,
    }


def _time_evaluation(prior: Density, count: int, settings: SpeedBenchmarkSettings) -> float:
    curve, follow_settings = curves.circle(radius=4.0), FollowSettings()
    frames = follow_settings.window.frames
    arcs = torch.arange(2 * frames, dtype=torch.float64) * 1.2 / PRIOR_FPS
    terms_of = build_follow_terms(curve, arcs, follow_settings)
    generator = torch.Generator().manual_seed(settings.seed)
    start = select_initial_state(
        prior, curve, arcs, terms_of, skeleton=CANONICAL, fps=PRIOR_FPS, generator=generator
    ).committed
    context = WindowContext(prior, start.state, start.place, start.joints_world, frames)
    unknowns = 0.1 * torch.randn(count, frames * LAYOUT.continuous, generator=generator)
    objective = Objective(LatentNoise.from_unknowns(context, unknowns).build, terms_of(1, frames))
    return 1000 * _time_fastest(lambda: objective.energy_and_gradient(unknowns), settings.repeats)


def _benchmark_follow(prior: Density, seconds: float, settings: SpeedBenchmarkSettings) -> Row:
    began = time.process_time()
    solution = follow_to_end(prior, curves.circle(radius=4.0), seconds, settings.seed, FollowSettings())
    frames = solution.motion.num_frames
    windows = solution.windows
    return {
        "what": f"follow a circle for {seconds:g} s",
        "ms_per_frame": 1000 * (time.process_time() - began) / frames,
        "evaluations_per_window": sum(w.evaluations for w in windows) / len(windows),
    }


def follow_to_end(
    prior: Density,
    curve: Curve,
    seconds: float,
    seed: int,
    settings: FollowSettings,
    terms: Sequence[Term] = (),
    *,
    speed: float = USUAL_SPEED,
) -> Solution:
    """Follow a curve to its end; Ctrl-C ends the benchmark, since half a walk belongs in no table."""
    generator = torch.Generator().manual_seed(seed)
    solution = follow(prior, curve, seconds=seconds, speed=speed, settings=settings, terms=terms, generator=generator)
    if solution.status.outcome is Outcome.INTERRUPTED:
        raise KeyboardInterrupt
    return solution


def _time_fastest(run: Callable[[], object], repeats: int) -> float:
    run()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return min(times)
