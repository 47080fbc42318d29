"""The loop of live steering: it owns the clock, asks any source for commands, and hands frames to any display.

The frames of a step are due when the ones before them have been shown. A step begins when those before it begin to be
shown, so a command waits for two steps at most: 0.2 s at three frames a step.

On a machine that is too slow, a step that begins late searches less, but has time for
`SteerSettings.least_evaluations`, by what steps cost lately, so that commands are obeyed. If its frames are still
later than `_SLACK`, the stream's time is held for as long: motion plays slower than real time, and no frame and no
command is dropped. Where other processes hold steps up beyond the time that they were given, those that follow are to
end earlier: several characters that share a machine's last processor all search less before any is late.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
import torch

from controllers.steering.steer import Refusal, SteerFrames, SteerState, Stepper, step
from mapctl.arguments import read_number
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import Command, CommandTrack
from mapctl.metrics.travel import list_misses, measure_arrivals, measure_commands
from mapctl.motion import Motion
from mapctl.problem.solution import Ledger
from mapctl.rotations import make_sign_continuous
from mapctl.runtime.live_protocol import FrameChunk

_MARGIN, _MOST_MARGIN = 0.015, 0.05  # seconds before frames are due at which a step is to end, for the display
_MARGIN_USED, _MARGIN_RISE, _MARGIN_FALL = 0.75, 1.5, 0.997  # found within a second, and forgotten within a minute
_SLACK = 0.1  # seconds by which frames may be late before time is held for them; less is caught up by searching less

Source: TypeAlias = Callable[[float], Command]
"""Seconds of the stream to the command that holds then: a script's `at`, a joystick, a web page."""
Display: TypeAlias = Callable[[SteerFrames, float], None]
"""Takes frames and the second of the stream at which the first of them is to be visible."""


class StreamClock:
    """Time that passes only by waiting: as fast as the machine can, so that nothing is late."""

    real = False
    """Whether time passes by itself, so that a step has a deadline."""

    def __init__(self):
        self._now = -1.0

    def now(self) -> float:
        """Return the time, seconds; -1 before the first wait."""
        return self._now

    def wait_until(self, seconds: float) -> None:
        """Wait until that time; return at once if it has passed."""
        self._now = max(self._now, seconds)

    def hold(self, seconds: float) -> None:
        """Set the time back by so many seconds."""


class WallClock(StreamClock):
    """Real time since the clock was started, less the time for which it was held."""

    real = True

    def __init__(self):
        self._began = time.perf_counter()

    def now(self) -> float:
        return time.perf_counter() - self._began

    def wait_until(self, seconds: float) -> None:
        if (left := seconds - self.now()) > 0:
            time.sleep(left)

    def hold(self, seconds: float) -> None:
        self._began += seconds

    def perf_counter_at(self, seconds: float) -> float:
        """Return the value of time.perf_counter, seconds, at a time of this clock, if it is not held until then."""
        return self._began + seconds


@dataclass(frozen=True)
class StepRecord:
    """Cost and time of one step."""

    frames: int
    """Number of frames delivered."""
    asked: float
    """Second of the stream at which the command was read."""
    due: float
    """Second of the stream at which the first of the frames was due."""
    delivered: float
    """Second of the stream at which the frames were delivered."""
    seconds: float
    """Compute, seconds."""
    evaluations: int
    """Evaluations of energy and gradient."""
    note: str
    """Why the search was cut short; empty if it was not."""
    held: float = 0.0
    """Seconds for which the stream's time was held after it."""

    @property
    def late_frames(self) -> int:
        """Number of frames delivered after they were due."""
        return sum(self.delivered > self.due + k / PRIOR_FPS for k in range(self.frames))


@dataclass
class Recorder:
    """Keeps everything that its display `show` is given, as one motion."""

    pieces: list[SteerFrames] = field(default_factory=list)
    """All that was shown, step by step."""

    def show(self, frames: SteerFrames, due: float) -> None:
        """Keep the frames; when they are `due` (seconds of the stream) does not matter."""
        self.pieces.append(frames)

    def motion(self, frames: int | None = None) -> Motion:
        """Return all that was shown, or the first so many frames."""
        if not self.pieces:
            raise RequestError("nothing was shown")
        first = self.pieces[0].motion
        roots = torch.cat([piece.motion.root_position for piece in self.pieces])[:frames]
        quats = torch.cat([piece.motion.local_quat_xyzw for piece in self.pieces])[:frames]
        return Motion(first.skeleton, first.fps, roots, make_sign_continuous(quats))

    @property
    def refusals(self) -> list[Refusal]:
        """Orders that were not obeyed."""
        return [piece.refusal for piece in self.pieces if piece.refusal is not None]

    def judge(self, track: CommandTrack, frames: int | None = None) -> dict[str, list[Any]]:
        """Judge all that was shown, or the first so many frames, by the commands under which it was steered.

        Keys: `commands` and `arrivals`, rows of `mapctl.metrics.travel`, and `misses`, a sentence with numbers for each
        field that was not obeyed.
        """
        motion, refusals = self.motion(frames), self.refusals
        commands = measure_commands(motion, track)
        arrivals = measure_arrivals(motion, track, [refusal.order for refusal in refusals])
        misses = [*(refusal.reason for refusal in refusals), *list_misses(commands, arrivals)]
        return {"commands": commands, "arrivals": arrivals, "misses": misses}

    @property
    def ledger(self) -> Ledger:
        """Ledger of all solved frames."""
        return reduce(Ledger.join, (piece.ledger for piece in self.pieces if piece.ledger.entries), Ledger())


_KEPT_FRAMES = 30  # delivered frames that can still be asked for: an engine shows a step while the next is solved


class Playback:
    """The pose at any time of the stream, for an engine of any frame rate: a display, `show`, and `at`."""

    def __init__(self):
        self._first = 0  # index of the first kept frame
        self._delivered: Motion | None = None
        self._whole: Motion | None = None  # with the forecast after it

    def show(self, frames: SteerFrames, due: float) -> None:
        """Keep frames, the first of them `due` at that second of the stream, and their forecast. Frames that were kept
        from there on are forgotten: they were rolled back."""
        start, motion = round(due * PRIOR_FPS), frames.motion
        kept = 0 if self._delivered is None else min(self._delivered.num_frames, start - self._first)
        if self._delivered is not None and kept > 0 and self._first + kept == start:
            first = max(0, kept - _KEPT_FRAMES)
            motion, start = self._delivered.slice(first, kept).join(motion), self._first + first
        self._first, self._delivered = start, motion
        self._whole = motion if frames.ahead is None else motion.join(frames.ahead)

    def at(self, seconds: float) -> Motion:
        """Return the pose at a second of the stream, a motion of one frame: between delivered frames, or between those
        of the forecast where no more are delivered; at its end it stands still."""
        if self._whole is None:
            raise RequestError("nothing was shown")
        frame = PRIOR_FPS * read_number(seconds, "the second of a pose") - self._first
        return self._whole.sample(torch.tensor([frame], dtype=torch.float64))


def make_chunk(
    frames: SteerFrames, due: float, seconds: float, *, spare: float = 0.0, notes: tuple[str, ...] = ()
) -> FrameChunk:
    """Return the frames of a step as plain arrays, to send to another process; the other values as of FrameChunk."""
    return FrameChunk(
        due,
        seconds,
        frames.motion.root_position.numpy(),
        frames.motion.local_quat_xyzw.numpy(),
        frames.contacts.numpy(),
        frames.forecast.numpy(),
        frames.steering_targets[-1].velocity,
        frames.steering_targets[-1].facing,
        spare,
        frames.seconds,
        frames.root_velocity.numpy(),
        frames.trajectory.numpy(),
        notes,
    )


def find_second_zero(clock: StreamClock, state: SteerState) -> float:
    """Return the clock's time at the stream's second 0, for a next step that begins now."""
    return clock.now() + (state.settings.commit - state.frames) / PRIOR_FPS


def iterate_steps(
    state: SteerState,
    source: Source,
    displays: Sequence[Display],
    *,
    clock: StreamClock,
    stepper: Stepper | None = None,
) -> Iterator[tuple[SteerState, StepRecord]]:
    """Yield one step after the other without end; the first pose counts as delivered.

    Frame k is due at second k / PRIOR_FPS. The clock starts a step before that.
    """
    lead = state.settings.commit / PRIOR_FPS
    begun, margin = find_second_zero(clock, state), _MARGIN
    while True:
        due = state.frames / PRIOR_FPS
        clock.wait_until(begun + due - lead)
        asked = clock.now() - begun
        left = due - asked - margin
        needed = state.cost.rest + state.settings.least_evaluations * state.cost.evaluation
        seconds = max(left, needed) if clock.real else None
        state, new = (stepper or step)(state, source(asked), seconds=seconds)
        delivered = clock.now() - begun
        if due - delivered < _MARGIN_USED * margin:
            margin = max(margin, min(_MOST_MARGIN, _MARGIN_RISE * margin))
        else:
            margin = max(_MARGIN, _MARGIN_FALL * margin)
        held = delivered - due if clock.real and delivered - due > _SLACK else 0.0
        if held:
            clock.hold(held)  # before they are shown, since they are due now
        for display in displays:
            display(new, due)
        frames, note = new.motion.num_frames, "; ".join(new.notes)
        yield state, StepRecord(frames, asked, due, delivered, new.seconds, new.evaluations, note, held)


def drive(
    state: SteerState,
    source: Source,
    displays: Sequence[Display],
    *,
    frames: int,
    clock: StreamClock | None = None,
    stepper: Stepper | None = None,
) -> tuple[SteerState, list[StepRecord]]:
    """Steer until `frames` have been delivered, or Ctrl-C."""
    records: list[StepRecord] = []
    stream = iterate_steps(state, source, displays, clock=clock or StreamClock(), stepper=stepper)
    try:
        while state.frames < frames:
            state, record = next(stream)
            records.append(record)
    except KeyboardInterrupt:
        if not records:
            raise
    return state, records


def summarise_step_timing(
    records: Sequence[StepRecord], arrivals: Sequence[float] = ()
) -> dict[str, float | int | None]:
    """Summarise for a report: compute of each frame, late frames, evaluations, and the longest latency of a command.

    `arrivals` are the seconds of the stream at which commands came. The latency of a command runs from its arrival to
    the due time of the first frame that it could still change.
    """
    each = np.repeat([1000 * r.seconds / r.frames for r in records], [r.frames for r in records])
    count = sum(record.frames for record in records)
    dues = [next((record.due for record in records if record.asked >= at - 1e-9), None) for at in arrivals]
    latencies = [due - at for at, due in zip(arrivals, dues, strict=True) if due is not None]
    # Of a command that arrives just after the source was asked, the longest over all steps.
    worst = max((b.due - a.asked for a, b in pairwise(records)), default=None)
    return {
        "frame_ms_p50": float(np.percentile(each, 50)) if count else None,
        "frame_ms_p99": float(np.percentile(each, 99)) if count else None,
        "frame_ms_max": float(each.max()) if count else None,
        "late_frames": sum(record.late_frames for record in records),
        "evaluations_per_frame": sum(record.evaluations for record in records) / max(1, count),
        "steps_cut_short": sum(bool(record.note) for record in records),
        "held_s": sum(record.held for record in records),
        "command_latency_s": max(latencies, default=worst),
        "threads": torch.get_num_threads(),
    }
