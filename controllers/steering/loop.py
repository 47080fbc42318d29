"""The loop of live steering: it owns the clock, asks any source for commands, and hands frames to any display.

The frames of a step are due when the ones before them have been shown. A step begins when those before it begin to be
shown, so a command waits for two steps at most: 0.2 s at three frames a step.

Where the machine is too slow, this is the rule. A step that begins late searches less, but never less than
`SteerSettings.least_evaluations`, so commands are obeyed. If its frames are later than `LoopSettings.slack` all the
same, the stream's time stands still for as long: motion plays slower than real time, and no frame and no command is
left out.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from controllers.steering.steer import SteerFrames, SteerState, step
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command, SteeringTarget
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.rotations import make_sign_continuous


@runtime_checkable
class Source(Protocol):
    """Where commands come from: a script, a joystick, a web page."""

    def at(self, seconds: float) -> Command:
        """The command that holds now, at so many seconds of the stream."""
        ...


@runtime_checkable
class Display(Protocol):
    """Where frames go to."""

    def show(self, frames: SteerFrames, due: float) -> None:
        """Frames in time; `due` is the second of the stream at which the first of them is to be seen."""
        ...


@runtime_checkable
class Clock(Protocol):
    """Seconds of the stream."""

    real: bool
    """Whether time passes by itself, so that a step has a deadline."""

    def now(self) -> float:
        """The time."""
        ...

    def wait_until(self, seconds: float) -> None:
        """Return at that time, or at once if it has passed."""
        ...

    def hold(self, seconds: float) -> None:
        """Let so many seconds of real time not have counted."""
        ...


class WallClock:
    """Real time, from the making on, less what it was held for."""

    real = True

    def __init__(self):
        self._began = time.perf_counter()

    def now(self) -> float:
        """See Clock."""
        return time.perf_counter() - self._began

    def wait_until(self, seconds: float) -> None:
        """See Clock."""
        if (left := seconds - self.now()) > 0:
            time.sleep(left)

    def hold(self, seconds: float) -> None:
        """See Clock."""
        self._began += seconds


class StreamClock:
    """Time that passes only by waiting: as fast as the machine can, and nothing is ever late."""

    real = False

    def __init__(self):
        self._now = -1.0

    def now(self) -> float:
        """See Clock."""
        return self._now

    def wait_until(self, seconds: float) -> None:
        """See Clock."""
        self._now = max(self._now, seconds)

    def hold(self, seconds: float) -> None:
        """See Clock; nothing is late, so nobody asks."""


@dataclass(frozen=True)
class LoopSettings:
    """How the loop keeps its time."""

    margin: float = 0.026
    """Seconds before frames are due at which the search for them ends: what is left to do then takes that long."""
    slack: float = 0.1
    """Seconds by which frames may be late before time stands still for them; less is made up for by searching less."""


@dataclass(frozen=True)
class StepRecord:
    """Cost and time of one step."""

    frames: int
    """Delivered."""
    asked: float
    """Second of the stream at which the source was asked."""
    due: float
    """Second at which the first of the frames was due."""
    delivered: float
    """Second at which they were there."""
    seconds: float
    """Compute."""
    evaluations: int
    """Of energy and gradient."""
    note: str
    """Why less was searched than could have been, if so."""
    held: float = 0.0
    """Seconds for which time then stood still."""

    @property
    def late_frames(self) -> int:
        """Frames that came after they were due."""
        return sum(self.delivered > self.due + k / PRIOR_FPS for k in range(self.frames))


@dataclass
class Recorder:
    """A Display that keeps everything, as one motion."""

    pieces: list[SteerFrames] = field(default_factory=list)

    def show(self, frames: SteerFrames, due: float) -> None:
        """Keep them."""
        self.pieces.append(frames)

    def motion(self, frames: int | None = None) -> Motion:
        """All that was shown, or the first so many frames."""
        if not self.pieces:
            raise RequestError("nothing was shown")
        first = self.pieces[0].motion
        roots = torch.cat([piece.motion.root_position for piece in self.pieces])[:frames]
        quats = torch.cat([piece.motion.local_quat_xyzw for piece in self.pieces])[:frames]
        return Motion(first.skeleton, first.fps, roots, make_sign_continuous(quats))

    @property
    def steering_targets(self) -> list[SteeringTarget]:
        """Of every frame."""
        return [wish for piece in self.pieces for wish in piece.steering_targets]

    @property
    def ledger(self) -> Ledger:
        """Of every solved frame."""
        ledger = Ledger()
        for piece in self.pieces:
            ledger = ledger.join(piece.ledger) if piece.ledger.entries else ledger
        return ledger


def iterate_steps(
    state: SteerState,
    source: Source,
    displays: Sequence[Display],
    *,
    clock: Clock,
    settings: LoopSettings | None = None,
) -> Iterator[tuple[SteerState, StepRecord]]:
    """Steer without end, a step at a time; the first pose counts as delivered.

    Frame k is due at second k / PRIOR_FPS. The clock starts a step before that.
    """
    settings = settings or LoopSettings()
    lead = state.settings.commit / PRIOR_FPS
    begun = clock.now() - state.frames / PRIOR_FPS + lead
    while True:
        due = state.frames / PRIOR_FPS
        clock.wait_until(begun + due - lead)
        asked = clock.now() - begun
        left = due - asked - settings.margin if clock.real else None
        state, new = step(state, source.at(asked), seconds=None if left is None else max(0.0, left))
        delivered = clock.now() - begun
        held = delivered - due if clock.real and delivered - due > settings.slack else 0.0
        if held:
            clock.hold(held)  # before they are shown: they are due now
        for display in displays:
            display.show(new, due)
        yield (
            state,
            StepRecord(
                new.motion.num_frames, asked, due, delivered, new.seconds, new.evaluations, "; ".join(new.notes), held
            ),
        )


def drive(
    state: SteerState,
    source: Source,
    displays: Sequence[Display],
    *,
    frames: int,
    clock: Clock | None = None,
    settings: LoopSettings | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[SteerState, list[StepRecord]]:
    """Steer until `frames` have been delivered, or `stop()` says so, or Ctrl-C."""
    records: list[StepRecord] = []
    stream = iterate_steps(state, source, displays, clock=clock or StreamClock(), settings=settings)
    try:
        while state.frames < frames and not stop():
            state, record = next(stream)
            records.append(record)
    except KeyboardInterrupt:
        if not records:
            raise
    return state, records


def summarise_step_timing(
    records: Sequence[StepRecord], arrivals: Sequence[float] = ()
) -> dict[str, float | int | None]:
    """For a report: compute of each frame, late frames, evaluations, and the longest latency of a command.

    The latency of a command runs from its arrival to the due time of the first frame that it could still change.
    """
    each = np.repeat([1000 * r.seconds / r.frames for r in records], [r.frames for r in records])
    count = sum(record.frames for record in records)
    latencies = [seen - at for at in arrivals if (seen := _find_first_affected_due(records, at)) is not None]
    return {
        "frame_ms_p50": float(np.percentile(each, 50)) if count else None,
        "frame_ms_p99": float(np.percentile(each, 99)) if count else None,
        "frame_ms_max": float(each.max()) if count else None,
        "late_frames": sum(record.late_frames for record in records),
        "evaluations_per_frame": sum(record.evaluations for record in records) / max(1, count),
        "steps_cut_short": sum(bool(record.note) for record in records),
        "held_s": sum(record.held for record in records),
        "command_latency_s": max(latencies, default=_worst_latency(records)),
        "threads": torch.get_num_threads(),
    }


def _find_first_affected_due(records: Sequence[StepRecord], arrival: float) -> float | None:
    return next((record.due for record in records if record.asked >= arrival - 1e-9), None)


def _worst_latency(records: Sequence[StepRecord]) -> float | None:
    """Of a command that comes just after the source was asked."""
    return max((b.due - a.asked for a, b in pairwise(records)), default=None)
