"""What the solver costs and which of its choices pay: the tables behind `mapctl bench`. Ratios within one run."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from controllers.common.initial_state import select_initial_state
from controllers.following.follow import FollowSettings, build_follow_terms, follow
from controllers.generation.generate import GenerateSettings, initialise_generation
from mapctl import curves
from mapctl.curves import Curve
from mapctl.features import LAYOUT, PRIOR_FPS, ground_speed
from mapctl.metrics import measure
from mapctl.metrics.states import summarise_states
from mapctl.problem.context import WindowContext
from mapctl.problem.feature_states import FeatureStateSolver
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.objective import Objective
from mapctl.problem.solution import Outcome, Solution
from mapctl.problem.warm_start import BestOfSamples, SwarmProposal
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.terms import LatentPrior, Likelihood

Row = dict[str, Any]


@dataclass(frozen=True)
class SolverBenchmarkSettings:
    """How long to measure."""

    seconds: float = 5.0
    """Of motion in each solve of the ablation."""
    repeats: int = 40
    """Evaluations timed; the fastest counts, since other work on the machine only adds."""
    particles: tuple[int, ...] = (1, 4, 16, 32)
    """Batch sizes."""
    lengths: tuple[float, ...] = (4.0, 8.0, 16.0)
    """Seconds of motion, to show that cost grows linearly."""
    seed: int = 0
    """Of starts and draws."""


def benchmark_speed(
    prior: Density, reference: Density, settings: SolverBenchmarkSettings = SolverBenchmarkSettings()
) -> list[Row]:
    """Energy and gradient of one window on the fast path and on the torch `reference`, then whole solves."""
    rows = [_benchmark_evaluation(prior, reference, count, settings) for count in settings.particles]
    return rows + [_benchmark_follow(prior, seconds, settings) for seconds in settings.lengths]


def benchmark_free_run(
    prior: Density, data: Mapping[str, float], *, runs: int = 8, frames: int = 10_000, seed: int = 0
) -> list[Row]:
    """Long free runs at temperature 1: a row each, and one of their means beside the training `data`'s own values.

    A character that had stopped would show in its slowest second; one that came apart in its largest feature, in
    standard deviations.
    """
    rows, everything = [], []
    for run in range(runs):
        features = _sample_free_run(prior, frames, seed + run)
        everything.append(features)
        pace = ground_speed(features)
        seconds = pace[: len(pace) // PRIOR_FPS * PRIOR_FPS].unflatten(0, (-1, PRIOR_FPS)).mean(-1)
        rows.append(
            {
                "run": str(run),
                **summarise_states(features),
                "slowest_second_m_s": float(seconds.min()),
                "fastest_second_m_s": float(seconds.max()),
                "largest_feature_sigma": float(_standardise_features(prior, features).abs().max()),
            }
        )
    return [*rows, {"run": "all", **summarise_states(torch.cat(everything))}, {"run": "training data", **data}]


def _sample_free_run(prior: Density, frames: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    told, state, _ = initialise_generation(prior, GenerateSettings(), None, generator)
    return told.sample(state, frames, generator)[0][0]


def _standardise_features(prior: Density, features: Tensor) -> Tensor:
    size = LAYOUT.continuous
    return ((features - prior.feature_mean) / prior.feature_std)[..., :size]


def benchmark_ablation(prior: Density, settings: SolverBenchmarkSettings = SolverBenchmarkSettings()) -> list[Row]:
    """Starts and unknowns compared: energy, path error and time on three smooth curves and a corner."""
    shapes = {
        "circle:4": curves.circle(radius=4.0),
        "figure8:2": curves.figure8(radius=2.0),
        "s:6": curves.s(length=6.0),
        "corner": curves.from_points(torch.tensor([[0.0, 0.0], [0.0, 3.0], [3.0, 3.0]], dtype=torch.float64)),
    }
    return [
        {"curve": name, **_evaluate_variant(prior, curve, wishes, label, settings)}
        for name, curve in shapes.items()
        for label, wishes in list_ablation_variants(prior).items()
    ]


def list_ablation_variants(prior: Density) -> dict[str, FollowSettings]:
    """The variants of the ablation by name."""
    plain, size = LatentNoiseSolver(), LAYOUT.continuous
    best = replace(plain, proposal=BestOfSamples(count=32), budget=Budget(evaluations=152))
    flown = replace(plain, proposal=SwarmProposal(), budget=Budget(evaluations=216))
    states = FeatureStateSolver(prior.feature_std[:size], prior.feature_mean[:size])
    return {
        "latents, zero start": FollowSettings(method=plain),
        "latents, best of 32": FollowSettings(method=best),
        "latents, swarm 16 x 6": FollowSettings(method=flown),
        # Here the noise is that of the network's input, in units of its sigma, and the states need a density.
        "states, 160 evaluations": FollowSettings(method=states, noise=LatentPrior(sigma=1.0), extra=(Likelihood(),)),
    }


def _evaluate_variant(
    prior: Density, curve: Curve, wishes: FollowSettings, label: str, settings: SolverBenchmarkSettings
) -> Row:
    began = time.process_time()
    solution = _follow_to_end(prior, curve, settings.seconds, settings.seed, wishes)
    spent = time.process_time() - began
    found = measure(solution.motion, curve)
    return {
        "method": label,
        "energy_nats": _target_energy(solution),
        "path_error_mean_cm": found["path_error_mean_cm"],
        "path_error_max_cm": found["path_error_max_cm"],
        "contact_speed_cm_s": found["contact_speed_cm_s"],
        "jitter_m_s3": found["jitter_m_s3"],
        "ms_per_frame": 1000 * spent / solution.motion.num_frames,
    }


def _target_energy(solution: Solution) -> float:
    """Nats of the wishes, which all variants share (the prior's part is measured in different spaces)."""
    return float(sum(e.energy.sum() for e in solution.ledger.entries if e.name in ("path", "footing")))


def _benchmark_evaluation(prior: Density, reference: Density, count: int, settings: SolverBenchmarkSettings) -> Row:
    fast, slow = (_time_evaluation(p, count, settings) for p in (prior, reference))
    return {
        "what": f"energy and gradient, 34 frames, {count} candidates",
        "fast_ms": fast,
        "reference_ms": slow,
        "times_faster": slow / fast,
        "fast_ms_per_candidate": fast / count,
    }


def _time_evaluation(prior: Density, count: int, settings: SolverBenchmarkSettings) -> float:
    curve, wishes = curves.circle(radius=4.0), FollowSettings()
    frames = wishes.window.frames
    arcs = torch.arange(2 * frames, dtype=torch.float64) * 1.2 / PRIOR_FPS
    terms_of = build_follow_terms(curve, arcs, wishes)
    generator = torch.Generator().manual_seed(settings.seed)
    start = select_initial_state(
        prior, curve, arcs, terms_of, skeleton=CANONICAL, fps=PRIOR_FPS, generator=generator
    ).committed
    context = WindowContext(prior, start.state, start.place, start.joints_world, frames)
    unknowns = 0.1 * torch.randn(count, frames * LAYOUT.continuous, generator=generator)
    objective = Objective(LatentNoise.from_unknowns(context, unknowns).build, terms_of(1, frames))
    return 1000 * _time_fastest(lambda: objective.energy_and_gradient(unknowns), settings.repeats)


def _benchmark_follow(prior: Density, seconds: float, settings: SolverBenchmarkSettings) -> Row:
    began = time.process_time()
    solution = _follow_to_end(prior, curves.circle(radius=4.0), seconds, settings.seed, FollowSettings())
    frames = solution.motion.num_frames
    windows = solution.windows
    return {
        "what": f"follow a circle for {seconds:g} s",
        "ms_per_frame": 1000 * (time.process_time() - began) / frames,
        "evaluations_per_window": sum(w.evaluations for w in windows) / len(windows),
    }


def _follow_to_end(prior: Density, curve: Curve, seconds: float, seed: int, wishes: FollowSettings) -> Solution:
    """A walk to its end: half a one has no place in a table, so Ctrl-C ends the bench."""
    generator = torch.Generator().manual_seed(seed)
    solution = follow(prior, curve, seconds=seconds, settings=wishes, generator=generator)
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
