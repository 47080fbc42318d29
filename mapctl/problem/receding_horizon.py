"""Sliding windows: solve one, commit its first frames, advance the prior, go on (rnn paper, section 5.2).

The only place that advances a prior's state during a solve.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose, integrate_root
from mapctl.problem.context import WindowContext
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, WindowRecord
from mapctl.problem.window_solvers import LatentNoiseSolver, SingleWindowSolver
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.base import Term

TermsOf = Callable[[int, int], Sequence[Term]]
"""Terms of the window that begins at a frame and has so many frames."""


@dataclass(frozen=True)
class HorizonSettings:
    """How windows are laid."""

    frames: int = 34
    """Length of a window (the paper's)."""
    overlap: int = 17
    """Frames of it that the next window solves again."""
    past: int = 40
    """Committed frames that terms may look back on."""

    def __post_init__(self):
        if not 0 <= self.overlap < self.frames or self.past < 1:
            raise RequestError(f"windows need frames > overlap >= 0 and past >= 1, got {self}")


@dataclass(frozen=True, eq=False)
class CommittedFrames:
    """Everything fixed so far."""

    state: Any
    """The density's state after it, batch of one."""
    place: GroundPose
    """Of its last frame."""
    features: Float[Tensor, "frames size"]
    """Of every committed frame, the first being the start."""
    joints_world: Float[Tensor, "past joints 3"]
    """World joint positions of its last frames, metres."""
    warm_start: Float[Tensor, "ahead width"]
    """What the last window found for the frames beyond: where the next one starts (see the method's `carry`)."""
    ledger: Ledger = field(default_factory=Ledger)
    """Of the solved frames."""
    windows: tuple[WindowRecord, ...] = ()
    """Cost of each window."""
    forecast: Float[Tensor, "ahead joints 3"] | None = None
    """World joint positions of the frames that the last window found beyond, metres."""

    def finite(self, count: int) -> bool:
        """Whether the last `count` frames and their energies are numbers."""
        checked = (self.features[-count:], *(entry.energy[-count:] for entry in self.ledger.entries))
        return all(bool(torch.isfinite(values).all()) for values in checked)


@dataclass(frozen=True, eq=False)
class RecedingHorizonSolver:
    """What stays the same from window to window."""

    density: Density
    """The prior."""
    settings: HorizonSettings = field(default_factory=HorizonSettings)
    """Lengths and budgets."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = PRIOR_FPS
    """Frames per second."""
    method: SingleWindowSolver = field(default_factory=LatentNoiseSolver)
    """How one window is solved."""

    def solve(
        self,
        committed: CommittedFrames,
        terms_of: TermsOf,
        frames: int,
        *,
        generator: torch.Generator,
        progress: Callable[[int, int], None] | None = None,
        deadline: float | None = None,
    ) -> tuple[CommittedFrames, Outcome]:
        """Extend `committed` to `frames` frames; stops early, with all that is committed, at the deadline or Ctrl-C.

        `deadline` is a time.monotonic() value in seconds; the window it falls into is committed as far as it was
        improved by then. Windows always look their full length ahead, so the last frames are solved with a future too.
        KeyboardInterrupt goes on where nothing has been solved yet.
        """
        begun = len(committed.features)
        try:
            while (done := len(committed.features)) < frames:
                if (left := _seconds_until(deadline)) <= 0:
                    return committed, Outcome.BUDGET
                count = min(self.settings.frames - self.settings.overlap, frames - done)
                following = self._solve_next(committed, terms_of(done, self.settings.frames), count, generator, left)
                if not following.windows[-1].evaluations and _seconds_until(deadline) <= 0:
                    return committed, Outcome.BUDGET
                if not following.finite(count):
                    return committed, Outcome.NOT_FINITE
                committed = following
                if progress is not None:
                    progress(min(len(committed.features), frames), frames)
        except KeyboardInterrupt:
            if len(committed.features) == begun:
                raise
            return committed, Outcome.INTERRUPTED
        return committed, Outcome.DONE

    def _solve_next(
        self, done: CommittedFrames, terms: Sequence[Term], count: int, generator: torch.Generator, seconds: float
    ) -> CommittedFrames:
        began = time.perf_counter()
        context = WindowContext(
            self.density, done.state, done.place, done.joints_world, self.settings.frames, self.skeleton, self.fps
        )
        window = self.method(context, terms, done.warm_start, generator, seconds=seconds)
        features = window.trial.features[0, :count]
        ground, heading = integrate_root(features, done.place)
        joints = torch.cat([done.joints_world, window.trial.joints_world[0, :count]])[-self.settings.past :]
        state = self.density.advance(done.state, features.unsqueeze(0))
        record = WindowRecord(
            count,
            time.perf_counter() - began,
            window.evaluations,
            window.start_energy,
            window.energy,
            window.stop_reason,
        )
        return CommittedFrames(
            state=state,
            place=GroundPose(ground[-1], heading[-1]),
            features=torch.cat([done.features, features]),
            joints_world=joints,
            warm_start=window.carry[count:],
            ledger=done.ledger.join(window.ledger.slice(count)),
            windows=(*done.windows, record),
            forecast=window.trial.joints_world[0, count:],
        )


def _seconds_until(deadline: float | None) -> float:
    return math.inf if deadline is None else deadline - time.monotonic()
