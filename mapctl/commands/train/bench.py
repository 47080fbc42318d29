"""`mapctl bench training`: time and memory of training each model, and how much faster several processes are.

Steps are taken at five points of a run, since what a step costs changes as gaps grow and critics join. Each measurement
has a process of its own, so that its peak of memory is its own; one process and several take turns.
"""

import math
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median

import torch

from mapctl.commands.bench import Training
from mapctl.commands.bench.output import print_rows
from mapctl.commands.train import MODELS
from mapctl.errors import RequestError
from mapctl.report import peak_memory_mb
from priors.training.gathering import gather
from priors.training.parallel import TrainingGroup, fork_group
from priors.training.recipe import Gathered
from priors.training.trainer import Trainer

_POINTS = (0.1, 0.3, 0.5, 0.7, 0.9)  # shares of a run at which steps are measured
_MEBIBYTE_MB = 2**20 / 1e6


@dataclass(frozen=True)
class Cost:
    """What steps of training cost."""

    seconds: float
    """For 100 steps, wall clock."""
    processor_seconds: float
    """For 100 steps, of all processes."""
    megabytes: float
    """Peak of the first process' memory; NaN where the system does not tell (Windows)."""


def run(command: Training) -> int:
    """Measure and print."""
    kinds = {kind.model: kind for kind in MODELS}
    names = list(kinds) if command.models == "all" else [name.strip() for name in command.models.split(",")]
    for name in names:
        if name not in kinds:
            raise RequestError(f"--models are all or some of {', '.join(kinds)}; got {name!r}")
    with tempfile.TemporaryDirectory(prefix="mapctl-") as folder:
        out = Path(folder) if command.cache is None else command.cache.parent
        rows = [_measure_model(name, command, out) for name in names]
    return print_rows(command, rows)


def _measure_model(name: str, command: Training, out: Path) -> dict[str, object]:
    # A timing is fitted by one process: there is no batch to share.
    many = command.processes if name != "keyframe-timing" else 1
    costs: dict[int, list[Cost]] = {count: [] for count in sorted({1, many})}
    for _ in range(command.rounds):
        for count, found in costs.items():
            found.append(_measure_apart(name, command.data, out, count, command.steps))
    row: dict[str, object] = {"model": name, **_summarise(costs[1], 1)}
    if many > 1:
        ratios = [one.seconds / other.seconds for one, other in zip(costs[1], costs[many], strict=True)]
        # On a machine that does other work too, the processor time of a process says what a wait for a core hides.
        works = [
            one.processor_seconds * many / other.processor_seconds
            for one, other in zip(costs[1], costs[many], strict=True)
        ]
        row |= {**_summarise(costs[many], many), "times faster": median(ratios), "by processor": median(works)}
    return row


def _summarise(costs: Sequence[Cost], processes: int) -> dict[str, float]:
    suffix = f", {processes} processes" if processes > 1 else ""
    return {
        f"s per 100 steps{suffix}": median(cost.seconds for cost in costs),
        f"processor s{suffix}": median(cost.processor_seconds for cost in costs),
        f"peak MB{suffix}": max(cost.megabytes for cost in costs),
    }


def _measure_apart(name: str, data: Path, out: Path, processes: int, steps: int) -> Cost:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(measure_steps, name, data, out, processes, steps).result()


def measure_steps(name: str, data: Path, out: Path, processes: int, steps: int) -> Cost:
    """Measure steps of a model's default recipe, so many at each point of the run; the clips are cached in `out`."""
    torch.set_num_threads(1)
    kind = next(kind for kind in MODELS if kind.model == name)
    recipe = replace(kind(data=data, out=out).recipe(), processes=processes)
    gathered = Gathered(*gather(recipe.source(), progress=lambda line: None, warn=lambda line: None))
    trainer = recipe.make_trainer(gathered.parts)
    found: list[tuple[float, float]] = []

    def work(group: TrainingGroup) -> None:
        trainer.join(group)
        found.append(_take_steps(trainer, steps))

    with fork_group(processes, work) as group:
        work(group)
    peak = peak_memory_mb()
    seconds, processor_seconds = (100 * each / (steps * len(_POINTS)) for each in found[0])
    return Cost(seconds, processor_seconds, math.nan if peak is None else peak * _MEBIBYTE_MB)


def _take_steps(trainer: Trainer, steps: int) -> tuple[float, float]:
    """Seconds, and seconds of all processors, that the steps took; one before each point is not counted."""
    wall, processor = 0.0, 0.0
    for share in _POINTS:
        trainer.step = max(1, round(share * trainer.steps))
        trainer.take_step()
        began, used = time.perf_counter(), time.process_time()
        for _ in range(steps):
            trainer.take_step()
        wall, processor = wall + time.perf_counter() - began, processor + time.process_time() - used
    return wall, float(trainer.group.gather(torch.tensor([processor], dtype=torch.float64)).sum())
