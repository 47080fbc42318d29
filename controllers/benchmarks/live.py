"""Benchmark of live steering by random commands against the wall clock: late frames, cost, memory, missed commands."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from controllers.benchmarks.shared.tables import Row
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.runtime.live_protocol import FrameChunk

_SPEEDS = (0.0, 0.8, 1.2, 1.6, 2.6)
_COMMAND_SECONDS = (4.5, 7.0)  # range of the time for which a command holds
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
    finally:
        for process in processes:
            process.close()
    return _summarise_logs(logs, minutes)


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
