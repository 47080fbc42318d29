"""`mapctl bench`: cost of the solver and of walks on this machine; no model is judged here (see `tests/benchmarks`)."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch

import priors
from controllers.common.initial_state import select_initial_state
from controllers.shots.shot import follow
from controllers.shots.walk import FollowSettings, build_follow_terms
from controllers.steering import steer
from mapctl import curves, report
from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.problem.objective import Objective
from mapctl.problem.solution import Outcome
from mapctl.problem.unknowns import LatentNoise, WindowContext
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL

Row = dict[str, object]
_SPEED = 1.2  # m/s of every walk


@dataclass(frozen=True)
class Bench(ModelCommand):
    """Cost on this machine: energy and gradient of a window, fast path and reference; following a curve; steering."""

    prints_licence: ClassVar[bool] = False

    prior: options.Prior = "locomotion"
    live: options.Name = "locomotion-live"
    """The prior that is steered: a bundled one, or the file or run folder of a trained one."""
    json: bool = False
    """Print JSON instead of a table."""


@dataclass(frozen=True)
class Sizes:
    """Size of the measurements."""

    repeats: int = 40
    """Number of timed evaluations; the fastest counts, since other work on the machine only adds."""
    candidates: tuple[int, ...] = (1, 4, 16, 32)
    """Batch sizes."""
    seconds: tuple[float, ...] = (4.0, 8.0, 16.0)
    """Lengths of walks: cost grows linearly with them."""
    steps: int = 40
    """Steps of steering."""


SIZES = Sizes()


def run(command: Bench) -> int:
    prior, live = priors.load(command.prior), priors.load(command.live)
    rows = [_measure_evaluation(prior, count, SIZES.repeats) for count in SIZES.candidates]
    rows += [_measure_follow(prior, seconds) for seconds in SIZES.seconds]
    rows.append(_measure_steer(live, SIZES.steps))
    if command.json:
        print(report.to_json({"bench": "speed", "versions": report.package_versions(), "rows": rows}), end="")
    else:
        columns = list(dict.fromkeys(name for row in rows for name in row))
        outputs.print_table(columns, [[row.get(name) for name in columns] for row in rows], title="cost, one thread")
    return 0


def _measure_evaluation(prior: "priors.LstmGmmDensity", count: int, repeats: int) -> Row:
    """Time energy and gradient of one window on the fast path and on the torch reference."""
    fast, slow = (_time_evaluation(each, count, repeats) for each in (prior, prior.without_kernels()))
    return {
        "what": f"energy and gradient, 34 frames, {count} candidates",
        "fast_ms": fast,
        "reference_ms": slow,
        "times_faster": slow / fast,
        "fast_ms_per_candidate": fast / count,
    }


def _time_evaluation(prior: Density, count: int, repeats: int) -> float:
    curve, settings = curves.circle(radius=4.0), FollowSettings()
    frames = settings.window.frames
    arcs = torch.arange(2 * frames, dtype=torch.float64) * _SPEED / PRIOR_FPS
    terms_of = build_follow_terms(curve, arcs, settings, torch.zeros(len(arcs), LAYOUT.continuous))
    generator = torch.Generator().manual_seed(0)
    start = select_initial_state(prior, curve, arcs, terms_of, skeleton=CANONICAL, generator=generator).committed
    context = WindowContext(prior, start.state, start.ground_pose, start.joints_world, frames)
    unknowns = 0.1 * torch.randn(count, frames * LAYOUT.continuous, generator=generator)
    objective = Objective(LatentNoise.from_unknowns(context, unknowns).build, terms_of(1, frames))
    return 1000 * _time_fastest(lambda: objective.energy_and_gradient(unknowns), repeats)


def _time_fastest(run: Callable[[], object], repeats: int) -> float:
    run()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        times.append(time.perf_counter() - began)
    return min(times)


def _measure_follow(prior: Density, seconds: float) -> Row:
    began = time.process_time()
    generator = torch.Generator().manual_seed(0)
    solution = follow(prior, curves.circle(radius=4.0), seconds=seconds, speed=_SPEED, generator=generator)
    if solution.status.outcome is Outcome.INTERRUPTED:
        raise KeyboardInterrupt
    windows = solution.windows
    return {
        "what": f"follow a circle for {seconds:g} s",
        "ms_per_frame": 1000 * (time.process_time() - began) / solution.motion.num_frames,
        "evaluations_per_window": sum(window.evaluations for window in windows) / len(windows),
    }


def _measure_steer(prior: Density, steps: int) -> Row:
    state, _ = steer.begin(prior, Command(_SPEED, 0.0), generator=torch.Generator().manual_seed(0))
    for _ in range(5):
        state, _ = steer.step(state, Command(_SPEED, 0.0))
    began, frames = time.process_time(), 0
    for number in range(steps):
        state, new = steer.step(state, Command(_SPEED, 0.3 * math.sin(number / 20)))
        frames += new.motion.num_frames
    return {"what": "steer", "ms_per_frame": 1000 * (time.process_time() - began) / frames}
