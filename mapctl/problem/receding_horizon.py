"""The receding horizon: solve a window, commit its first frames, advance the prior, go on (Wang et al. 2019, section
5.2). Following, steering, foot clean-up, denoising and in-betweening all solve their windows here, and nothing else
advances a prior's state during a solve.
"""

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, GroundPose, integrate_root
from mapctl.problem.density_selection import DensityEnsemble
from mapctl.problem.solution import Ledger, Outcome, WindowRecord
from mapctl.problem.unknowns import WindowContext, WindowRequest
from mapctl.problem.window_solvers import LatentNoiseSolver, SingleWindowSolver, SolvedWindow
from mapctl.protocols import AnyDensity, DensityState
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial

if hasattr(os, "register_at_fork"):
    # The threads that torch began do not survive a fork: a child that counted on them would wait for ever.
    os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))

TermsOf = Callable[[int, int], Sequence[Term]]
"""(first frame, number of frames) of a window to its terms."""


@dataclass(frozen=True)
class HorizonSettings:
    """Lengths of windows."""

    frames: int = 34
    """Length of a window, frames (as in the paper)."""
    overlap: int = 17
    """Look-ahead: frames of a window that the next one solves again."""
    past: int = 40
    """Number of committed frames whose joint positions are kept for the terms."""
    beyond_end: bool = True
    """Whether windows have their full length beyond the motion's end, so that its last frames are solved with a
    look-ahead too; if not, they end with the motion, as where all of it is proposed."""

    def __post_init__(self):
        if not 0 <= self.overlap < self.frames or self.past < 1:
            raise RequestError(f"windows need frames > overlap >= 0 and past >= 1, got {self}")

    def lay_window(self, done: int, frames: int) -> tuple[int, int]:
        """Return the length of the window after `done` of `frames` frames, and how many of its frames are committed."""
        left = frames - done
        if self.beyond_end:
            return self.frames, min(self.frames - self.overlap, left)
        return min(self.frames, left), left if left <= self.frames else self.frames - self.overlap


@dataclass(frozen=True, eq=False)
class CommittedFrames:
    """Committed frames so far, and the warm start of the next window."""

    state: DensityState | tuple[DensityState, ...]
    """Density's state after the last frame, batch of one."""
    ground_pose: GroundPose
    """Ground pose of the last frame."""
    features: Float[Tensor, "frames size"]
    """Features of the committed frames, physical units; the first may be an initial state that was not solved."""
    joints_world: Float[Tensor, "past joints 3"]
    """World joint positions of the last frames, metres, oldest first."""
    warm_start: Float[Tensor, "ahead width"] = field(default_factory=lambda: torch.zeros(0, LAYOUT.continuous))
    """Warm start of the next window: what the last one found for its look-ahead (see `SolvedWindow`)."""
    ledger: Ledger = field(default_factory=Ledger)
    """Energy and residual of the solved frames."""
    windows: tuple[WindowRecord, ...] = ()
    """Record of each window, its cost among them."""
    forecast: Float[Tensor, "ahead joints 3"] | None = None
    """World joint positions of the last window's look-ahead, metres."""
    ahead: Float[Tensor, "ahead size"] | None = None
    """Features of that look-ahead."""
    discarded: int = 0
    """Number of committed frames before the first of `features`, which are no longer kept."""

    def discard_history(self, keep: int) -> "CommittedFrames":
        """Return this with the features of the last `keep` frames only, and without ledger, records and look-ahead."""
        gone = max(0, len(self.features) - keep)
        kept = replace(self, features=self.features[gone:], discarded=self.discarded + gone)
        return replace(kept, ledger=Ledger(), windows=(), forecast=None, ahead=None)

    @property
    def contacts(self) -> Bool[Tensor, "2"]:
        """Left and right toe planted in the last frame; neither before the first."""
        if not len(self.features):
            return torch.zeros(2, dtype=torch.bool)
        return LAYOUT.pick(self.features[-1], "contacts") > 0.5

    def locate_heels(self, skeleton: Skeleton) -> Float[Tensor, "past 2 3"]:
        """Return the world positions of the heels in the last frame, metres; none before the first."""
        if not (len(self.features) and len(self.joints_world)):
            return torch.zeros(0, 2, 3)
        last = self.features[-1:].clone()
        last[:, : LAYOUT.slices["root_height"].start] = 0  # it is where the last step has led already
        bits = LAYOUT.pick(last, "contacts") > 0.5
        return Trial(last[None], self.ground_pose, contacts=bits[None], skeleton=skeleton).heels_world[0]

    def finite(self, count: int) -> bool:
        """Return whether the last `count` frames and their energies are numbers."""
        checked = (self.features[-count:], *(entry.energy[-count:] for entry in self.ledger.entries))
        return all(bool(torch.isfinite(values).all()) for values in checked)


@dataclass(frozen=True, eq=False)
class RecedingHorizonSolver:
    """The receding horizon: what is the same for every window."""

    density: AnyDensity | DensityEnsemble
    """Density, or several of which the window solver selects one."""
    settings: HorizonSettings = field(default_factory=HorizonSettings)
    """Lengths of windows."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    method: SingleWindowSolver = field(default_factory=LatentNoiseSolver)
    """Solver of one window."""

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
        """Extend `committed` to `frames` frames; stop early, with what is committed, at the deadline or on Ctrl-C.

        `deadline` is a time.monotonic() value in seconds; the window into which it falls is committed as far as it was
        improved by then. KeyboardInterrupt is raised on where nothing has been solved yet.
        """
        begun = len(committed.features)
        try:
            while (done := len(committed.features)) < frames:
                if (left := _seconds_until(deadline)) <= 0:
                    return committed, Outcome.BUDGET
                length, count = self.settings.lay_window(done, frames)
                terms, began = terms_of(done, length), time.perf_counter()
                window = self.solve_window(committed, terms, length, generator=generator, seconds=left)
                following = self._commit(committed, window, count, time.perf_counter() - began)
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

    def solve_window(
        self,
        committed: CommittedFrames,
        terms: Sequence[Term],
        frames: int,
        *,
        generator: torch.Generator,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """Solve one window of so many frames after the committed ones; commit nothing."""
        context = WindowContext(
            self.density,
            committed.state,
            committed.ground_pose,
            committed.joints_world,
            frames,
            self.skeleton,
            contacts_before=committed.contacts,
            heels_before=committed.locate_heels(self.skeleton),
            first_frame=committed.discarded + len(committed.features),
        )
        return self.method(WindowRequest(context, terms, committed.warm_start, generator, seconds))

    def _commit(self, done: CommittedFrames, window: SolvedWindow, count: int, seconds: float) -> CommittedFrames:
        """Commit the first frames of a window that took so many seconds."""
        features = window.trial.features[0, :count]
        ground, heading = integrate_root(features, done.ground_pose)
        return CommittedFrames(
            state=self.density.advance(done.state, features.unsqueeze(0)),
            ground_pose=GroundPose(ground[-1], heading[-1]),
            features=torch.cat([done.features, features]),
            joints_world=torch.cat([done.joints_world, window.trial.joints_world[0, :count]])[-self.settings.past :],
            warm_start=window.warm_start[count:],
            ledger=done.ledger.join(window.ledger.pick(slice(count))),
            windows=(*done.windows, replace(window.record, frames=count, seconds=seconds)),
            forecast=window.trial.joints_world[0, count:],
            ahead=window.trial.features[0, count:],
            discarded=done.discarded,
        )


def replay(
    density: AnyDensity, features: Float[Tensor, "frames size"], state: DensityState | None = None, *, since: int = 0
) -> DensityState:
    """Return the density's state after observed frames, by its state before frame `since`; without one, by a state
    before the first frame that makes the motion likely (Wang et al. 2019, Eq. 26).
    """
    return density.advance(density.infer_state(features) if state is None else state, features[None, since:])


def _seconds_until(deadline: float | None) -> float:
    return math.inf if deadline is None else deadline - time.monotonic()
