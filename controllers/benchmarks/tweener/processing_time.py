"""Benchmark of speed (Zhou et al. 2020, table 3): seconds of one core for poses, the hips' way, exact keys on the rig,
and the MAP stage. It is the processor's time that counts, which others on the machine do not take.
"""

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.spliced_keys import KeySequence
from controllers.inbetweening.pipeline import InfillSettings
from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.protocols import Inbetweener, PathPredictor

REPEATS = 5
"""Times that each is measured; the median counts."""


@dataclass
class Stopwatch:
    """Seconds of the processor by name, summed."""

    seconds: dict[str, float] = field(default_factory=dict)
    """What was measured."""

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the seconds within."""
        began = time.process_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.process_time() - began


@dataclass(frozen=True, eq=False)
class TimedPath(PathPredictor):
    """A path predictor on a stopwatch, as `path`."""

    path: PathPredictor
    """Who predicts."""
    stopwatch: Stopwatch
    """Who is told."""

    def predict(self, motion: LocalMotion) -> RootTrajectory:
        """Predict as the other does."""
        with self.stopwatch.measure("path"):
            return self.path.predict(motion)


def benchmark_processing_time(
    sequences: Sequence[KeySequence],
    make: Callable[[Stopwatch], Inbetweener],
    *,
    finish: bool = True,
    repeats: int = REPEATS,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure a row for each sequence, medians in seconds: the `poses` and the `path` that an in-betweener tells its
    stopwatch, all else until keys are exact on the rig, and the MAP stage if it is to `finish`. One thread."""
    rows = []
    for number, sequence in enumerate(sequences):
        with _one_thread():
            measured = [_measure(sequence, make, finish) for _ in range(repeats)]
        row: Row = {"frames": len(sequence.known), "keys": int(sequence.known.sum())}
        rows.append(row | {name: statistics.median(each[name] for each in measured) for name in measured[0]})
        if progress is not None:
            progress(number + 1, len(sequences))
    return rows


def _measure(sequence: KeySequence, make: Callable[[Stopwatch], Inbetweener], finish: bool) -> dict[str, float]:
    stopwatch = Stopwatch()
    method = Method("timed", make(stopwatch), InfillSettings(finish=False))
    began = time.process_time()
    sequence.fill(method)
    whole = time.process_time() - began
    poses, path = (stopwatch.seconds.get(name, 0.0) for name in ("poses", "path"))
    row = {"poses_s": poses, "path_s": path, "keys_and_rig_s": whole - poses - path, "without_map_s": whole}
    if finish:
        method = replace(method, settings=InfillSettings())
        began = time.process_time()
        sequence.fill(method)
        row["map_s"] = time.process_time() - began - whole
    return row


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
