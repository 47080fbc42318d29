"""`mapctl bench`: cost of walks on this machine; no model is judged here (see `tests/benchmarks`)."""

import math
import time
from dataclasses import dataclass
from typing import ClassVar

import torch

import priors
from controllers.shots.shot import follow
from controllers.steering import steer
from mapctl import curves, report
from mapctl.commands.shared import options, outputs
from mapctl.commands.shared.command import ModelCommand
from mapctl.intent.steering import Command
from mapctl.problem.solution import Outcome
from mapctl.protocols import Density

Row = dict[str, object]
SECONDS = (4.0, 8.0, 16.0)
"""Lengths of walks: cost grows linearly with them."""
_STEPS = 40  # of steering
_SPEED = 1.2  # m/s of every walk


@dataclass(frozen=True)
class Bench(ModelCommand):
    """Cost on this machine: milliseconds a frame of following a curve, and of steering."""

    prints_licence: ClassVar[bool] = False

    prior: options.Prior = "locomotion"
    live: options.Name = "locomotion-live"
    """The prior that is steered: a bundled one, or the file or run folder of a trained one."""
    json: bool = False
    """Print JSON instead of a table."""


def run(command: Bench) -> int:
    prior, live = priors.load(command.prior), priors.load(command.live)
    _measure_follow(prior, 1.0)  # kernels are compiled or loaded, once a machine
    rows = [*(_measure_follow(prior, seconds) for seconds in SECONDS), _measure_steer(live)]
    if command.json:
        print(report.to_json({"bench": "speed", "versions": report.package_versions(), "rows": rows}), end="")
    else:
        columns = list(rows[0])
        outputs.print_table(columns, [[row.get(name) for name in columns] for row in rows], title="cost, one thread")
    return 0


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


def _measure_steer(prior: Density) -> Row:
    state, _ = steer.begin(prior, Command(_SPEED, 0.0), generator=torch.Generator().manual_seed(0))
    for _ in range(5):
        state, _ = steer.step(state, Command(_SPEED, 0.0))
    began, frames = time.process_time(), 0
    for number in range(_STEPS):
        state, new = steer.step(state, Command(_SPEED, 0.3 * math.sin(number / 20)))
        frames += new.motion.num_frames
    return {"what": "steer", "ms_per_frame": 1000 * (time.process_time() - began) / frames}
