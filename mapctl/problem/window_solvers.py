"""How one window is solved: over the latents of a rollout (the default), or over the states themselves."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext
from mapctl.problem.feature_states import FeatureStates
from mapctl.problem.latent_noise import LatentNoise
from mapctl.problem.ledger import Ledger
from mapctl.problem.objective import Objective
from mapctl.problem.warm_start import WarmStartProposal, keep_warm_start
from mapctl.protocols import DiscreteChoices
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsResult, LbfgsSettings, minimise
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class SolvedWindow:
    """The best that was found for one window."""

    trial: Trial
    """Batch of one, detached."""
    carry: Float[Tensor, "frames width"]
    """By frame, what the next window may start from."""
    ledger: Ledger
    """By term and frame."""
    evaluations: int
    """Spent in all, proposals included."""
    start_energy: float
    """Nats at the first point of L-BFGS."""
    energy: float
    """Nats at the end."""
    stop_reason: str
    """Why L-BFGS stopped."""


@runtime_checkable
class SingleWindowSolver(Protocol):
    """Solves one window."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        tail: Float[Tensor, "frames width"],
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """`tail` is the end of the last window's `carry`, empty at the start; `seconds` are left."""
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
    """Of one round."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=120))
    """Of one window."""
    proposal: WarmStartProposal = keep_warm_start
    """Where the first round starts."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        tail: Tensor,
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """See Method; the carry is the noise."""
        meter = Meter(self.budget.within(seconds))
        unknowns = self.proposal(context, terms, _extend_warm_start(tail, context.frames), meter, generator)
        best = self._run_round(context, terms, unknowns, meter)
        start_energy = float(best[1].start_energy[0])
        for _ in range(self.rounds - 1):
            if meter.exhausted or not best[1].energy[0] > self.energy_threshold * context.frames:
                break
            again = self._run_round(context, terms, best[1].x, meter)
            if not again[1].energy[0] < best[1].energy[0]:
                break
            best = again
        objective, result = best
        carry = result.x[0].unflatten(-1, (context.frames, LAYOUT.continuous))
        return _build_solved_window(objective, result, carry, meter, start_energy)

    def _run_round(
        self, context: WindowContext, terms: Sequence[Term], unknowns: Tensor, meter: Meter
    ) -> tuple[Objective, LbfgsResult]:
        objective = Objective(LatentNoise.from_unknowns(context, unknowns).build, terms)
        return objective, minimise(objective.energy_and_gradient, unknowns, settings=self.lbfgs, meter=meter)


@dataclass(frozen=True, eq=False)
class GuidedNoiseSolver:
    """L-BFGS over the latents of a given motion: its components and contact bits are kept, its noise is where to start.

    For motion that is to be changed a little; the terms say what about it.
    """

    guide: Float[Tensor, "frames size"]
    """Features of the window's frames, physical units."""
    share: float = 0.5
    """Of the guide's noise that the search starts with: 1 starts at the guide itself, 0 at the prior's mean."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=24))
    """Of one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=60))
    """Of one window."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        tail: Tensor,
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """See Method; the carry is the noise, where the next window starts instead of the guide."""
        meter = Meter(self.budget.within(seconds))
        plan, noise = context.density.latents(self.guide.unsqueeze(0), context.state)
        start = self.share * noise[0]
        start[: len(tail)] = tail[: len(start)]
        unknowns = start.flatten().unsqueeze(0)
        objective = Objective(LatentNoise(context, plan).build, terms)
        result = minimise(objective.energy_and_gradient, unknowns, settings=self.lbfgs, meter=meter)
        carry = result.x[0].unflatten(-1, (context.frames, LAYOUT.continuous))
        return _build_solved_window(objective, result, carry, meter, float(result.start_energy[0]))


@dataclass(frozen=True, eq=False)
class FeatureStateSolver:
    """L-BFGS over the states and the network's input noise, with teacher forcing (Eq. 14-19).

    The terms should hold a likelihood. Starts from the last window's states and the prior's plain continuation of them.
    """

    scale: Float[Tensor, " continuous"]
    """The prior's standard deviations: one unit of each unknown."""
    centre: Float[Tensor, " continuous"]
    """The prior's means."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=150))
    """Of one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=160))
    """Of one window."""

    def __call__(
        self,
        context: WindowContext,
        terms: Sequence[Term],
        tail: Tensor,
        generator: torch.Generator,
        *,
        seconds: float = math.inf,
    ) -> SolvedWindow:
        """See Method; the carry is the features."""
        meter = Meter(self.budget.within(seconds))
        features, plan = _continue_features(context, tail)
        states = FeatureStates(context, self.scale, self.centre, plan.contacts)
        objective = Objective(states.build, terms)
        result = minimise(
            objective.energy_and_gradient, states.from_features(features), settings=self.lbfgs, meter=meter
        )
        carry = states.build(result.x).features[0].detach()
        return _build_solved_window(objective, result, carry, meter, float(result.start_energy[0]))


def _build_solved_window(
    objective: Objective, result: LbfgsResult, carry: Tensor, meter: Meter, start_energy: float
) -> SolvedWindow:
    with torch.no_grad():
        trial = objective.build(result.x)
    return SolvedWindow(
        trial,
        carry,
        objective.build_ledger(trial),
        meter.evaluations,
        start_energy,
        float(result.energy[0]),
        result.status[0].value,
    )


def _extend_warm_start(tail: Tensor, frames: int) -> Float[Tensor, "1 unknowns"]:
    """The last solution's tail, and zero noise (the prior's own continuation) beyond it."""
    noise = tail.new_zeros(frames, LAYOUT.continuous)
    noise[: len(tail)] = tail[:frames]
    return noise.flatten().unsqueeze(0)


def _continue_features(context: WindowContext, tail: Tensor) -> tuple[Float[Tensor, "1 frames size"], DiscreteChoices]:
    """The tail's features and the prior's zero-noise rollout after them, and their contact bits."""
    known = tail[: context.frames].unsqueeze(0)
    state = context.density.advance(context.state, known) if len(tail) else context.state
    noise = tail.new_zeros(1, context.frames - known.shape[1], LAYOUT.continuous)
    plan = context.density.plan(state, noise)
    with torch.no_grad():
        beyond, _ = context.density.rollout(state, noise, plan)
    features = torch.cat([known, beyond], dim=1) if len(tail) else beyond
    bits = LAYOUT.pick(features, "contacts") > 0.5
    return features, DiscreteChoices(torch.zeros(bits.shape[:2], dtype=torch.long), bits)
