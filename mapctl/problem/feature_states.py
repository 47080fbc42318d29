"""Unknowns that are the features themselves, scored with teacher forcing, and the noise on the network's input (Wang et
al. 2019, Eq. 14-16).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext
from mapctl.problem.receding_horizon import replay
from mapctl.problem.window_solvers import SolvedWindow, minimise_window
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class FeatureStates:
    """Unknowns are features (in units of `scale`) and the noise on the network's input, side by side."""

    context: WindowContext
    """What is known before the window."""
    scale: Float[Tensor, " continuous"]
    """Physical size of one unit of each feature: the prior's standard deviations."""
    centre: Float[Tensor, " continuous"]
    """The prior's means."""
    contacts: Bool[Tensor, "1 frames 2"]
    """Fixed contact bits."""
    input_noise: float = 0.05
    """Standard deviation of the input noise, normalised units: what one unit of its unknowns is worth."""

    def from_features(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch unknowns"]:
        """Unknowns of a motion without input noise."""
        states = (features[..., : LAYOUT.continuous] - self.centre) / self.scale
        return torch.cat([states.flatten(1), torch.zeros_like(states).flatten(1)], dim=-1)

    def initial(self, warm_start: Float[Tensor, "ahead width"]) -> Float[Tensor, "1 unknowns"]:
        """The last window's features and the prior's zero-noise rollout after them."""
        return self.from_features(_continue_features(self.context, warm_start))

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Score the states with teacher forcing."""
        context, half = self.context, unknowns.shape[-1] // 2
        shape = (context.frames, LAYOUT.continuous)
        states, noise = unknowns[:, :half].unflatten(-1, shape), unknowns[:, half:].unflatten(-1, shape)
        bits = self.contacts.expand(len(states), -1, -1).to(states.dtype)
        features = torch.cat([states * self.scale + self.centre, bits], dim=-1)
        inputs = features[..., : LAYOUT.continuous] + noise * self.input_noise * self.scale
        seen = torch.cat([inputs, bits], dim=-1)
        log_density = context.prior.log_prob(features, context.expand_state(len(states)), inputs=seen)
        contacts = self.contacts.expand(len(states), -1, -1)
        return context.build_trial(features, contacts, noise=noise, log_density=log_density)

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """The features by frame."""
        return self.build(unknowns).features[0].detach()


@dataclass(frozen=True, eq=False)
class FeatureStateSolver:
    """L-BFGS over feature states (Wang et al. 2019, Eq. 14-19). The terms should hold a likelihood.

    Starts from the last window's states and the prior's plain continuation of them, whose contact bits are kept.
    """

    scale: Float[Tensor, " continuous"]
    """The prior's standard deviations: one unit of each unknown."""
    centre: Float[Tensor, " continuous"]
    """The prior's means."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=150))
    """L-BFGS of one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=160))
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
        """Solve one window."""
        meter = Meter(self.budget.within(seconds))
        features = _continue_features(context, warm_start)
        states = FeatureStates(context, self.scale, self.centre, LAYOUT.pick(features, "contacts") > 0.5)
        return minimise_window(states, terms, states.from_features(features), self.lbfgs, meter)


def _continue_features(context: WindowContext, warm_start: Tensor) -> Float[Tensor, "1 frames size"]:
    """The last window's features and the prior's zero-noise rollout after them."""
    known = warm_start[: context.frames].unsqueeze(0)
    state = replay(context.prior, known[0], context.prior_state) if len(warm_start) else context.prior_state
    noise = warm_start.new_zeros(1, context.frames - known.shape[1], LAYOUT.continuous)
    with torch.no_grad():
        beyond, _ = context.prior.rollout(state, noise, context.prior.plan(state, noise))
    return torch.cat([known, beyond], dim=1) if len(warm_start) else beyond
