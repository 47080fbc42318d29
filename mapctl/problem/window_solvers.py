"""How one window is solved: a start, a parametrisation of its frames, and L-BFGS over the unknowns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.problem.context import WindowContext
from mapctl.problem.density_selection import DensityChoice
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.ledger import Ledger
from mapctl.problem.objective import Objective
from mapctl.problem.parametrisation import Parametrisation
from mapctl.problem.warm_start import WarmStartProposal, keep_warm_start
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsResult, LbfgsSettings, minimise
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """The best that was found for one window."""

    trial: Trial
    """The motion: batch of one, detached."""
    warm_start: Float[Tensor, "frames width"]
    """By frame, what the next window may start from (see `Parametrisation.warm_start`)."""
    ledger: Ledger
    """Energy and residual by term and frame."""
    evaluations: int
    """Evaluations spent in all, proposals included."""
    start_energy: float
    """Energy at the first point of L-BFGS, nats."""
    energy: float
    """Energy at the end, nats."""
    stop_reason: str
    """Why L-BFGS stopped."""
    choice: DensityChoice | None = None
    """Which of several densities scored the window, where there were several to choose from."""


@runtime_checkable
class SingleWindowSolver(Protocol):
    """Solves one window."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        warm_start: Float[Tensor, "ahead width"],
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """Solve it; `warm_start` is what the last window found for its first frames, empty at the start, and `seconds`
        are left.
        """
        ...


@dataclass(frozen=True)
class LatentNoiseSolver:
    """Propose, plan, then rounds of L-BFGS over the rollout's noise.

    Between rounds components and contact bits are chosen anew along the current rollout; a round that ends higher than
    the one before it is thrown away, since the plan itself is not part of the energy.
    """

    rounds: int = 3
    """Rounds at most."""
    energy_threshold: float = 8.0
    """Nats a frame below which no further round is begun: a new round forgets L-BFGS's curvature, which pays only where
    the last one is stuck. Windows are worth the effort, since one that lags behind leaves a debt to all after it."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=36))
    """L-BFGS of one round."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=120))
    """Budget of one window."""
    proposal: WarmStartProposal = keep_warm_start
    """Where the first round starts."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        warm_start: Tensor,
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """Solve one window."""
        meter = Meter(self.budget.within(seconds))
        start = self.proposal(context, terms, LatentNoise.extend(warm_start, context.frames), meter, generator)
        unknowns, best = self._run_round(context, terms, start, meter)
        start_energy = float(best.start_energy[0])
        for _ in range(self.rounds - 1):
            if meter.exhausted or not best.energy[0] > self.energy_threshold * context.frames:
                break
            replanned, again = self._run_round(context, terms, best.x, meter)
            if not again.energy[0] < best.energy[0]:
                break
            unknowns, best = replanned, again
        return replace(_build_solved_window(unknowns, terms, best, meter), start_energy=start_energy)

    def _run_round(
        self, context: WindowContext, terms: Sequence[Term], start: Tensor, meter: Meter
    ) -> tuple[LatentNoise, LbfgsResult]:
        unknowns = LatentNoise.from_unknowns(context, start)
        objective = Objective(unknowns.build, terms)
        return unknowns, minimise(objective.energy_and_gradient, start, settings=self.lbfgs, meter=meter)


@dataclass(frozen=True, eq=False)
class GuidedNoiseSolver:
    """L-BFGS over the latents of a given motion: its components and contact bits are kept, its noise is where to start.

    For motion that is to be changed a little; the terms say what about it.
    """

    guide: Float[Tensor, "frames size"]
    """Features of the window's frames, physical units."""
    share: float = 0.5
    """Share of the guide's noise that the search starts with: 1 starts at the guide itself, 0 at the prior's mean."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=24))
    """L-BFGS of one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=60))
    """Budget of one window."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        warm_start: Tensor,
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """Solve one window; where the last one overlaps it, its noise is the start instead of the guide's."""
        meter = Meter(self.budget.within(seconds))
        plan, noise = context.prior.latents(self.guide.unsqueeze(0), context.state)
        start = self.share * noise[0]
        start[: len(warm_start)] = warm_start[: len(start)]
        return minimise_window(LatentNoise(context, plan), terms, start.flatten().unsqueeze(0), self.lbfgs, meter)


def minimise_window(
    unknowns: Parametrisation,
    terms: Sequence[Term],
    start: Float[Tensor, "1 unknowns"],
    lbfgs: LbfgsSettings,
    meter: Meter,
) -> SolvedWindow:
    """Minimise the terms over a window's unknowns; the start itself where nothing finite was found."""
    result = minimise(Objective(unknowns.build, terms).energy_and_gradient, start, settings=lbfgs, meter=meter)
    if not bool(torch.isfinite(result.energy).all()):
        result = replace(result, x=start)
    return _build_solved_window(unknowns, terms, result, meter)


def _build_solved_window(
    unknowns: Parametrisation, terms: Sequence[Term], result: LbfgsResult, meter: Meter
) -> SolvedWindow:
    with torch.no_grad():
        trial = unknowns.build(result.x)
    return SolvedWindow(
        trial,
        unknowns.warm_start(result.x),
        Objective(unknowns.build, terms).build_ledger(trial),
        meter.evaluations,
        float(result.start_energy[0]),
        float(result.energy[0]),
        result.status[0].value,
    )
