"""Solvers of one window: a start, a parametrisation of its frames, and L-BFGS over the unknowns."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.problem.context import WindowRequest
from mapctl.problem.density_selection import DensityChoice
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.ledger import Ledger
from mapctl.problem.objective import Objective, Parametrisation
from mapctl.problem.warm_start import WarmStartProposal, keep_warm_start
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsResult, LbfgsSettings, minimise
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """The lowest energy that was found for one window, and where."""

    trial: Trial
    """Motion found: batch of one, detached."""
    warm_start: Float[Tensor, "frames width"]
    """What the next window may start from, by frame (see `Parametrisation.warm_start`)."""
    ledger: Ledger
    """Energy and residual by term and frame."""
    evaluations: int
    """Number of evaluations, those of warm start proposals included."""
    start_energy: float
    """Energy at the start of L-BFGS, nats."""
    energy: float
    """Energy of the trial, nats."""
    stop_reason: str
    """Reason why L-BFGS stopped."""
    choice: DensityChoice | None = None
    """Density of an ensemble that scored the window; None for a single density."""


@runtime_checkable
class SingleWindowSolver(Protocol):
    """Solves one window."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve the window; its result is detached, and no worse than its start."""
        ...


@dataclass(frozen=True)
class LatentNoiseSolver:
    """Propose a start, plan, then run rounds of L-BFGS over the rollout's noise.

    Before each round components and contact bits are planned anew along the current rollout; a round that ends higher
    than the one before it is discarded, since the plan itself is not part of the energy.
    """

    rounds: int = 3
    """Largest number of rounds."""
    energy_threshold: float = 8.0
    """Energy a frame, nats, below which no further round is run: a new round starts without curvature pairs, which pays
    only where the last one is stuck."""
    lbfgs: LbfgsSettings = field(
        default_factory=lambda: LbfgsSettings(max_iterations=36, relative_energy_tolerance=3e-3)
    )
    """Settings of L-BFGS in one round. A step that wins less than a 300th of the energy is the last: that spares three
    evaluations in ten, and walks are as near their paths (docs/reference/results.md)."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=120))
    """Budget of one window."""
    proposal: WarmStartProposal = keep_warm_start
    """Proposal of the first round's start."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window."""
        meter, frames = Meter(self.budget.within(request.seconds)), request.context.frames
        start = self.proposal(request, LatentNoise.extend(request.warm_start, frames), meter)
        unknowns, best = self._run_round(request, start, meter)
        start_energy = float(best.start_energy[0])
        for _ in range(self.rounds - 1):
            if meter.exhausted or not best.energy[0] > self.energy_threshold * frames:
                break
            replanned, again = self._run_round(request, best.x, meter)
            if not again.energy[0] < best.energy[0]:
                break
            unknowns, best = replanned, again
        return replace(_build_solved_window(unknowns, request.terms, best, meter), start_energy=start_energy)

    def _run_round(self, request: WindowRequest, start: Tensor, meter: Meter) -> tuple[LatentNoise, LbfgsResult]:
        unknowns = LatentNoise.begin_search(request.context, start)
        objective = Objective.of(unknowns, request.terms)
        return unknowns, minimise(objective.energy_and_gradient, start, settings=self.lbfgs, meter=meter)


@dataclass(frozen=True, eq=False)
class GuidedNoiseSolver:
    """L-BFGS over the latent noise of a given motion, whose components and contact bits are kept.

    For a motion that is to be changed a little; the terms say what of it.
    """

    guide: Float[Tensor, "frames size"]
    """Features of the window's frames, physical units."""
    share: float = 0.5
    """Share of the guide's noise from which the search starts: 1 is the guide itself, 0 the prior's mean."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=24))
    """Settings of L-BFGS in one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=60))
    """Budget of one window."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window; where the last one overlaps it, the search starts from its noise instead of the guide's."""
        meter, context = Meter(self.budget.within(request.seconds)), request.context
        plan, noise = context.prior.latents(self.guide.unsqueeze(0), context.prior_state)
        start = self.share * noise[0]
        start[: len(request.warm_start)] = request.warm_start[: len(start)]
        heels = context.plan_heels(self.guide.unsqueeze(0), plan.contacts)
        unknowns = LatentNoise(context, plan, heel_plan=heels)
        return minimise_window(unknowns, request.terms, start.flatten().unsqueeze(0), self.lbfgs, meter)


def minimise_window(
    unknowns: Parametrisation,
    terms: Sequence[Term],
    start: Float[Tensor, "1 unknowns"],
    lbfgs: LbfgsSettings,
    meter: Meter,
) -> SolvedWindow:
    """Minimise the terms' energies over a window's unknowns; the start itself is kept where nothing finite is found."""
    result = minimise(Objective.of(unknowns, terms).energy_and_gradient, start, settings=lbfgs, meter=meter)
    if not bool(torch.isfinite(result.energy).all()):
        result = replace(result, x=start)
    return _build_solved_window(unknowns, terms, result, meter)


def _build_solved_window(
    unknowns: Parametrisation, terms: Sequence[Term], result: LbfgsResult, meter: Meter
) -> SolvedWindow:
    objective = Objective.of(unknowns, terms)
    trial = objective.build_detached(result.x)
    return SolvedWindow(
        trial,
        unknowns.warm_start(result.x),
        objective.build_ledger(trial),
        meter.evaluations,
        float(result.start_energy[0]),
        float(result.energy[0]),
        result.status[0].value,
    )
