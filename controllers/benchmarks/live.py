"""Characters steered live by random commands against the wall clock: late frames, cost, memory, and who got stuck."""

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
_COMMAND_SECONDS = (4.5, 7.0)  # seconds for which a command holds
_EVALUATED_FRAMES = 60  # frames before the next command in which it must be obeyed
_VELOCITY_TOLERANCE, _VELOCITY_TOLERANCE_SHARE = (
    0.3,
    0.25,
)  # m/s, or share of the speed, by which the mean velocity may miss it


@dataclass
class _CharacterLog:
    """What one character did."""

    command: Command
    until: float
    frames: int = 0
    late: int = 0
    nonfinite_chunks: int = 0
    commands: int = 0
    missed: int = 0
    cost: list[float] = field(default_factory=list)
    evaluations: list[int] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    memory: list[float] = field(default_factory=list)

    def add(self, delivered: FrameChunk) -> None:
        count = len(delivered.root)
        self.frames += count
        self.nonfinite_chunks += not (np.isfinite(delivered.root).all() and np.isfinite(delivered.quats).all())
        self.places = [*self.places[-_EVALUATED_FRAMES:], *delivered.root[:, ::2]]
        if delivered.seconds > 1.0:
            self.late += sum(delivered.spare + k / PRIOR_FPS < 0 for k in range(count))
            self.cost.append(1000 * delivered.compute_seconds / count)
            self.evaluations.append(delivered.evaluations)

    def judge(self) -> None:
        """Whether the command was obeyed in its last two seconds."""
        way = np.array(self.places[-_EVALUATED_FRAMES:])
        velocity = (way[-1] - way[0]) * PRIOR_FPS / (len(way) - 1)
        speed, heading = self.command.speed, self.command.heading
        wanted = speed * np.array([math.sin(heading), math.cos(heading)])
        self.commands += 1
        self.missed += bool(
            np.linalg.norm(velocity - wanted) > max(_VELOCITY_TOLERANCE, _VELOCITY_TOLERANCE_SHARE * speed)
        )


def benchmark_live(
    load: Callable[[], Any],
    *,
    characters: int,
    minutes: float,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Row:
    """So many characters for so long, together in one row; `load` as in RemoteRequest."""
    draws = torch.Generator().manual_seed(seed)
    remotes = [CharacterProcess(CharacterRequest(load, Command(1.2, 0.0), seed + k)) for k in range(characters)]
    logs = [_CharacterLog(Command(1.2, 0.0), _COMMAND_SECONDS[0]) for _ in remotes]
    try:
        for remote in remotes:
            remote.wait()
        for now in _iterate_ticks(60 * minutes):
            for remote, log in zip(remotes, logs, strict=True):
                for delivered in remote.poll():
                    log.add(delivered)
                if now > log.until:
                    log.judge()
                    log.memory.append(remote.memory_mb())
                    log.command, log.until = _sample_command(draws), now + _sample_uniform(draws, *_COMMAND_SECONDS)
                    remote.command(log.command)
            if progress is not None:
                progress(round(now), round(60 * minutes))
    finally:
        for remote in remotes:
            remote.close()
    return _summarise_logs(logs, minutes)


def _iterate_ticks(seconds: float) -> Iterator[float]:
    began = time.perf_counter()
    while (now := time.perf_counter() - began) < seconds:
        yield now
        time.sleep(0.02)


def _sample_command(draws: torch.Generator) -> Command:
    speed = _SPEEDS[int(torch.randint(len(_SPEEDS), (1,), generator=draws))]
    return Command(speed, _sample_uniform(draws, -math.pi, math.pi))


def _sample_uniform(draws: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=draws, dtype=torch.float64))


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
