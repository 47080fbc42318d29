"""Benchmark of live steering by random commands against the wall clock: late frames, cost, memory, missed commands."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from controllers.benchmarks.shared.tables import Row
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.runtime.memory import measure_memory_mb, measure_own_memory_mb, measure_processor_seconds

_SPEEDS = (0.0, 0.8, 1.2, 1.6, 2.6)
_COMMAND_SECONDS = (4.5, 7.0)  # range of the time for which a command holds
_SETTLING_SECONDS, _IDLE_SECONDS = 0.5, 2.0  # seconds until who is paused is still, and of the look at it
_EVALUATED_FRAMES = 60  # frames before the next command in which it must be obeyed
_VELOCITY_TOLERANCE, _VELOCITY_TOLERANCE_SHARE = 0.3, 0.25  # m/s or share of the speed, the larger of the two


@dataclass
class _CharacterLog:
    """Log of one character."""

    command: Command
    until: float
    frames: int = 0
    late: int = 0
    nonfinite_chunks: int = 0
    commands: int = 0
    missed: int = 0
    cost: list[float] = field(default_factory=list)
    evaluations: list[int] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)

    def add(self, delivered: FrameChunk) -> None:
        count = len(delivered.root)
        self.frames += count
        self.nonfinite_chunks += not (np.isfinite(delivered.root).all() and np.isfinite(delivered.quats).all())
        self.positions = [*self.positions[-_EVALUATED_FRAMES:], *delivered.root[:, ::2]]
        if delivered.seconds > 1.0:
            self.late += sum(delivered.spare + k / PRIOR_FPS < 0 for k in range(count))
            self.cost.append(1000 * delivered.compute_seconds / count)
            self.evaluations.append(delivered.evaluations)

    def check_command(self) -> None:
        """Count the command, and count it as missed unless it was obeyed in its last two seconds."""
        positions = np.array(self.positions[-_EVALUATED_FRAMES:])
        velocity = (positions[-1] - positions[0]) * PRIOR_FPS / (len(positions) - 1)
        speed, heading = self.command.speed, self.command.heading
        wanted = speed * np.array([math.sin(heading), math.cos(heading)])
        self.commands += 1
        tolerance = max(_VELOCITY_TOLERANCE, _VELOCITY_TOLERANCE_SHARE * speed)
        self.missed += bool(np.linalg.norm(velocity - wanted) > tolerance)


def benchmark_live(
    load: Callable[[], Any],
    *,
    characters: int,
    minutes: float,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Row:
    """Steer so many characters for so long and sum them up in one row; `load` as in CharacterRequest."""
    generator = torch.Generator().manual_seed(seed)
    processes = [CharacterProcess(CharacterRequest(load, Command(1.2, 0.0), seed + k)) for k in range(characters)]
    logs = [_CharacterLog(Command(1.2, 0.0), _COMMAND_SECONDS[0]) for _ in processes]
    try:
        for process in processes:
            process.wait()
        for now in iterate_ticks(60 * minutes):
            for process, log in zip(processes, logs, strict=True):
                for delivered in process.poll():
                    log.add(delivered)
                if now > log.until:
                    log.check_command()
                    log.memory.append(process.memory_mb())
                    log.command = _sample_command(generator)
                    log.until = now + sample_uniform(generator, *_COMMAND_SECONDS)
                    process.command(log.command)
            if progress is not None:
                progress(round(now), round(60 * minutes))
        use = _measure_use(processes)
    finally:
        for process in processes:
            process.close()
    return {**_summarise_logs(logs, minutes), **use}


def find_most(measure: Callable[[int], Row], most: int) -> list[Row]:
    """Measure 1, 2, 4, ... characters, at most so many, until frames are late, then between the last two numbers; the
    row with the largest number of which no frame was late says so under `most`."""
    rows: dict[int, Row] = {}
    good, bad, count = 0, most + 1, 1
    while bad - good > 1:
        rows[count] = measure(count)
        if rows[count]["late_frames"]:
            bad = count
        else:
            good = count
        count = min(2 * good, most) if bad > most else (good + bad) // 2
    return [{"most": "yes" if count == good else "", **row} for count, row in sorted(rows.items())]


def _measure_use(processes: Sequence[CharacterProcess]) -> Row:
    """Measure memory now, and the processor time that all of them take while they are paused."""
    pids = [process.pid for process in processes if process.pid is not None]
    bases = {process.base_pid for process in processes if process.base_pid is not None}
    own, everybody = [measure_own_memory_mb(pid) for pid in pids], [*pids, *bases]
    total = sum(measure_memory_mb(pid) for pid in everybody)
    for process in processes:
        process.pause(True)
    time.sleep(_SETTLING_SECONDS)
    before = sum(measure_processor_seconds(pid) for pid in everybody)
    time.sleep(_IDLE_SECONDS)
    idle = (sum(measure_processor_seconds(pid) for pid in everybody) - before) / _IDLE_SECONDS
    return {
        "memory_mb_a_character": float(np.mean(own)) if own else math.nan,
        "memory_mb_all": total,
        "paused_core_percent": 100 * idle,
    }


def iterate_ticks(seconds: float) -> Iterator[float]:
    began = time.perf_counter()
    while (now := time.perf_counter() - began) < seconds:
        yield now
        time.sleep(0.02)


def _sample_command(generator: torch.Generator) -> Command:
    speed = _SPEEDS[int(torch.randint(len(_SPEEDS), (1,), generator=generator))]
    return Command(speed, sample_uniform(generator, -math.pi, math.pi))


def sample_uniform(generator: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def _summarise_logs(logs: list[_CharacterLog], minutes: float) -> Row:
    cost = np.concatenate([log.cost for log in logs])
    memory = [log.memory for log in logs if len(log.memory) > 1]
    return {
        "characters": len(logs),
        "minutes": minutes,
        "frames": sum(log.frames for log in logs),
        "late_frames": sum(log.late for log in logs),
        "not_finite": sum(log.nonfinite_chunks for log in logs),
        "frame_ms_p50": float(np.percentile(cost, 50)),
        "frame_ms_p99": float(np.percentile(cost, 99)),
        "evaluations_a_step": float(np.mean(np.concatenate([log.evaluations for log in logs]))),
        "commands": sum(log.commands for log in logs),
        "not_obeyed": sum(log.missed for log in logs),
        "memory_mb_first": max((m[1] for m in memory), default=math.nan),
        "memory_mb_last": max((m[-1] for m in memory), default=math.nan),
    }
