"""Sliding windows: solve one, commit its first frames, advance the prior, go on (rnn paper, section 5.2).

The only place that advances a prior's state during a solve.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT, Place, root_places
from mapctl.protocols import Density
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsResult, LbfgsSettings, minimise
from mapctl.solver.objective import Objective
from mapctl.solver.proposals import Proposal, zero_start
from mapctl.solver.result import Ledger, Outcome, WindowRecord
from mapctl.solver.variables import Context, Latents
from mapctl.terms.base import Term

TermsOf = Callable[[int, int], Sequence[Term]]
"""Terms of the window that begins at a frame and has so many frames."""


@dataclass(frozen=True)
class WindowSettings:
    """How windows are laid and solved."""

    frames: int = 34
    """Length of a window (the paper's)."""
    overlap: int = 17
    """Frames of it that the next window solves again."""
    rounds: int = 3
    """How often components and contact bits are chosen anew along the current rollout."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=10))
    """Of one round."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=40))
    """Of one window."""
    past: int = 40
    """Committed frames that terms may look back on."""


@dataclass(frozen=True, eq=False)
class Committed:
    """Everything fixed so far."""

    state: Any
    """The density's state after it, batch of one."""
    place: Place
    """Of its last frame."""
    features: Float[Tensor, "frames size"]
    """Of every committed frame, the first being the start."""
    joints_world: Float[Tensor, "past joints 3"]
    """World joint positions of its last frames, metres."""
    tail: Float[Tensor, "frames continuous"]
    """Noise of the last window beyond what was committed: where the next one starts."""
    ledger: Ledger = field(default_factory=Ledger)
    """Of the solved frames."""
    windows: tuple[WindowRecord, ...] = ()
    """Cost of each window."""


@dataclass(frozen=True, eq=False)
class WindowSolver:
    """What stays the same from window to window."""

    density: Density
    """The prior."""
    settings: WindowSettings = field(default_factory=WindowSettings)
    """Lengths and budgets."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = 30.0
    """Frames per second."""
    proposal: Proposal = zero_start
    """Where L-BFGS starts."""

    def solve(
        self, committed: Committed, terms_of: TermsOf, frames: int, *, generator: torch.Generator,
        progress: Callable[[int, int], None] | None = None, deadline: float | None = None,
    ) -> tuple[Committed, Outcome]:  # fmt: skip
        """Extend `committed` to `frames` frames; stops early, with all that is committed, at the deadline.

        `deadline` is a time.monotonic() value in seconds. Windows always look their full length ahead, so the last
        frames are solved with a future too.
        """
        while (done := len(committed.features)) < frames:
            if deadline is not None and time.monotonic() >= deadline:
                return committed, Outcome.BUDGET
            count = min(self.settings.frames - self.settings.overlap, frames - done)
            committed = self._next(committed, terms_of(done, self.settings.frames), count, generator)
            if not torch.isfinite(committed.features[-count:]).all():
                return replace(committed, features=committed.features[:-count]), Outcome.NOT_FINITE
            if progress is not None:
                progress(min(len(committed.features), frames), frames)
        return committed, Outcome.DONE

    def _next(self, done: Committed, terms: Sequence[Term], count: int, generator: torch.Generator) -> Committed:
        began = time.perf_counter()
        context = Context(self.density, done.state, done.place, done.joints_world, self.settings.frames,
                          self.skeleton, self.fps)  # fmt: skip
        window = solve_window(context, terms, done.tail, self.settings, self.proposal, generator)
        trial = window.latents.build(window.result.x)
        with torch.no_grad():
            features = trial.features[0, :count]
            ground, heading = root_places(features, done.place)
            joints = torch.cat([done.joints_world, trial.joints_world[0, :count]])[-self.settings.past :]
        noise = window.result.x[0].unflatten(-1, (self.settings.frames, LAYOUT.continuous))
        record = WindowRecord(count, time.perf_counter() - began, window.evaluations, window.start_energy,
                              float(window.result.energy[0]), window.result.status[0].value)  # fmt: skip
        return Committed(
            state=self.density.advance(done.state, features.unsqueeze(0)), place=Place(ground[-1], heading[-1]),
            features=torch.cat([done.features, features]), joints_world=joints, tail=noise[count:].detach(),
            ledger=done.ledger.join(window.ledger.slice(count)), windows=(*done.windows, record),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """The best of one window."""

    latents: Latents
    """Unknowns to trial, with the last plan."""
    result: LbfgsResult
    """Of the last round, batch of one."""
    ledger: Ledger
    """By term and frame."""
    evaluations: int
    """Spent in all, proposals included."""
    start_energy: float
    """Nats at the first candidate of L-BFGS."""


def solve_window(
    context: Context, terms: Sequence[Term], tail: Float[Tensor, "frames continuous"], settings: WindowSettings,
    proposal: Proposal, generator: torch.Generator,
) -> SolvedWindow:  # fmt: skip
    """Propose, plan, then rounds of L-BFGS; between rounds the plan is chosen anew unless that costs more than it won."""
    meter = Meter(settings.budget)
    unknowns = proposal(context, terms, _extended(tail, context.frames), meter, generator)
    best: tuple[Latents, Objective, LbfgsResult] | None = None
    start_energy = float("nan")
    for _ in range(settings.rounds):
        latents = Latents.planned(context, unknowns)
        objective = Objective(latents.build, terms)
        result = minimise(objective.energy_and_gradient, unknowns, settings=settings.lbfgs, meter=meter)
        if best is None:
            start_energy = float(result.start_energy[0])
        elif not result.energy[0] < best[2].energy[0]:
            break
        best = latents, objective, result
        unknowns = result.x
        if meter.exhausted:
            break
    assert best is not None
    latents, objective, result = best
    return SolvedWindow(latents, result, objective.ledger(result.x), meter.evaluations, start_energy)


def _extended(tail: Tensor, frames: int) -> Float[Tensor, "1 unknowns"]:
    """The last solution's tail, and zero noise (the prior's own continuation) beyond it."""
    noise = tail.new_zeros(frames, LAYOUT.continuous)
    noise[: len(tail)] = tail[:frames]
    return noise.flatten().unsqueeze(0)
