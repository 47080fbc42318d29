"""Benchmark of orders to be somewhere, given to a live character: delay, accuracy, late frames."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from controllers.benchmarks.live import iterate_ticks, sample_uniform
from controllers.benchmarks.shared.tables import Row
from controllers.steering.process import CharacterProcess, CharacterRequest
from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command
from mapctl.kinematics import forward_kinematics
from mapctl.metrics.worst_frame import measure_peaks
from mapctl.runtime.live_protocol import FrameChunk
from mapctl.skeleton import CANONICAL, TOES

_SPEEDS = (0.7, 1.5)  # m/s, of the ways and of the walks after them
_WITHIN = (1.0, 1.8)  # seconds
_AHEAD = math.radians(60)  # to either side of where it goes
_SPEED_TOLERANCE, _SPEED_TOLERANCE_SHARE = 0.3, 0.25  # m/s or share of the speed, the larger of the two
_MEASURED = ("seen_s", "off_s", "place_cm", "facing_deg")
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))


@dataclass(eq=False)
class _Order:
    """An order, and what became of it."""

    sent: float
    """Value of time.perf_counter."""
    place: tuple[float, float]
    facing: float
    within: float
    command: Command
    chunks: list[FrameChunk] = field(default_factory=list)
    """Frames on the way to the place; the first of them were solved, to set out towards it."""

    def take(self, delivered: FrameChunk) -> None:
        """Take frames in; those of a way to a place were solved by nobody, but for the step before them."""
        if delivered.due <= self.sent:
            return
        if not delivered.evaluations:
            self.chunks.append(delivered)
        elif not self.chunks or self.chunks[-1].evaluations:
            self.chunks = [delivered]

    def measure(self) -> Row:
        """Measure an order that was carried out: seconds until it was seen, seconds by which the way took longer or
        shorter than asked, and errors on its last frame, cm and degrees."""
        first, last = self.chunks[0], self.chunks[-1]
        end = last.due + len(last.root) / PRIOR_FPS
        facing = float(rotations.split_heading(torch.from_numpy(last.quats[-1:, 0]))[0])
        return {
            "seen_s": first.due - self.sent,
            # Counted from when it was asked, one step before its first frames are due.
            "off_s": end - (first.due - len(first.root) / PRIOR_FPS + self.within) - 1 / PRIOR_FPS,
            "place_cm": 100 * math.dist(last.root[-1, ::2].tolist(), self.place),
            "facing_deg": math.degrees(abs(math.remainder(facing - self.facing, 2 * math.pi))),
        }


@dataclass(eq=False)
class _Log:
    """What the character did."""

    orders: list[_Order] = field(default_factory=list)
    chunks: list[FrameChunk] = field(default_factory=list)
    speeds: list[bool] = field(default_factory=list)
    """Whether the speed was reached after each arrival."""

    @property
    def place(self) -> tuple[tuple[float, float], float]:
        """Where it is, and the direction in which it goes, radians."""
        ground = np.concatenate([chunk.root[:, ::2] for chunk in self.chunks[-5:]])
        step = ground[-1] - ground[0]
        return (float(ground[-1, 0]), float(ground[-1, 1])), math.atan2(*step.tolist())

    def check_speed(self) -> None:
        """See whether the last command's speed was held over the last half second."""
        ground = np.concatenate([chunk.root[:, ::2] for chunk in self.chunks])[-16:]
        speed = float(np.linalg.norm(ground[-1] - ground[0])) * PRIOR_FPS / 15
        wanted = self.orders[-1].command.speed
        self.speeds.append(abs(speed - wanted) <= max(_SPEED_TOLERANCE, _SPEED_TOLERANCE_SHARE * wanted))


def benchmark_orders(
    load: Callable[[], Any],
    load_transitions: Callable[[], Any],
    *,
    minutes: float,
    every: float,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Row:
    """Order a character to be somewhere every so many seconds, and sum up in one row how it obeyed."""
    generator, log = torch.Generator().manual_seed(seed), _Log()
    process = CharacterProcess(CharacterRequest(load, Command(1.2, 0.0), seed, transitions=load_transitions))
    try:
        process.wait()
        due = every
        for now in iterate_ticks(60 * minutes):
            for delivered in process.poll():
                log.chunks.append(delivered)
                for order in log.orders[-1:]:
                    order.take(delivered)
            if now > due:
                if log.orders:
                    log.check_speed()
                log.orders.append(_send_order(process, log, generator))
                due += every
            if progress is not None:
                progress(round(now), round(60 * minutes))
    finally:
        process.close()
    return _summarise(log, minutes)


def _send_order(process: CharacterProcess, log: _Log, generator: torch.Generator) -> _Order:
    (x, z), heading = log.place
    away, within = sample_uniform(generator, *_SPEEDS), sample_uniform(generator, *_WITHIN)
    toward = heading + sample_uniform(generator, -_AHEAD, _AHEAD)
    facing = toward + sample_uniform(generator, -_AHEAD, _AHEAD)
    place = (x + away * within * math.sin(toward), z + away * within * math.cos(toward))
    command = Command(sample_uniform(generator, *_SPEEDS), facing)
    sent = time.perf_counter()
    process.go(command, place, within, facing)
    return _Order(sent, place, facing, within, command)


def _summarise(log: _Log, minutes: float) -> Row:
    done = [order.measure() for order in log.orders[:-1] if len(order.chunks) > 1]
    frames = [chunk.motion(CANONICAL) for chunk in log.chunks]
    root = torch.cat([motion.root_position for motion in frames])
    quats = torch.cat([motion.local_quat_xyzw for motion in frames])
    joints = forward_kinematics(CANONICAL.offsets.double(), CANONICAL.parents, root.double(), quats.double())[0]
    peaks = measure_peaks(joints[:, _EFFECTORS], root.double(), PRIOR_FPS)
    return {
        "minutes": minutes,
        "orders": len(log.orders[:-1]),
        "carried_out": len(done),
        "frames": len(root),
        "late_frames": sum(chunk.late_frames for chunk in log.chunks if chunk.seconds > 1.0),
        **{f"{name}_most": max((abs(each[name]) for each in done), default=math.nan) for name in _MEASURED},
        "speeds_reached": sum(log.speeds),
        "step_cm": 100 * peaks.step,
        "acceleration_m_s2": peaks.acceleration,
    }
