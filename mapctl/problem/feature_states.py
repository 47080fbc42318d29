"""Unknowns that are the features themselves, scored with teacher forcing, and the noise on the network's input (Wang et
al. 2019, Eq. 14-16).
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext, WindowRequest
from mapctl.problem.receding_horizon import replay
from mapctl.problem.window_solvers import SolvedWindow, minimise_window
from mapctl.solver.budget import Budget, Meter
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class FeatureStates:
    """Unknowns are features, in units of `scale` about `centre`, and the noise on the network's input, side by side."""

    context: WindowContext
    """What is known before the window."""
    scale: Float[Tensor, " continuous"]
    """Physical size of one unit of each feature: the prior's standard deviations."""
    centre: Float[Tensor, " continuous"]
    """Features of unknowns 0, physical units: the prior's means."""
    contacts: Bool[Tensor, "1 frames 2"]
    """Left and right toe planted in each frame; fixed."""
    heel_plan: Trial | None = None
    """Motion whose poses say which heels are planted; None: each candidate's own do."""
    input_noise: float = 0.05
    """Standard deviation of the input noise, normalised units: one unit of its unknowns (the paper's 0.05)."""

    def from_features(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch unknowns"]:
        """Convert features, physical units, to unknowns without input noise."""
        states = (features[..., : LAYOUT.continuous] - self.centre) / self.scale
        return torch.cat([states.flatten(1), torch.zeros_like(states).flatten(1)], dim=-1)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trials of the features, scored with teacher forcing; differentiable."""
        context, half = self.context, unknowns.shape[-1] // 2
        shape = (context.frames, LAYOUT.continuous)
        states, noise = torch.unflatten(unknowns[:, :half], -1, shape), torch.unflatten(unknowns[:, half:], -1, shape)
        bits = self.contacts.expand(len(states), -1, -1).to(states.dtype)
        features = torch.cat([states * self.scale + self.centre, bits], dim=-1)
        noisy = features[..., : LAYOUT.continuous] + noise * self.input_noise * self.scale
        inputs = torch.cat([noisy, bits], dim=-1)
        log_density = context.prior.log_prob(features, context.expand_state(len(states)), inputs=inputs)
        contacts = self.contacts.expand(len(states), -1, -1)
        return context.build_trial(features, contacts, noise=noise, log_density=log_density, heel_plan=self.heel_plan)

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """Return the features by frame."""
        return self.build(unknowns).features[0].detach()


@dataclass(frozen=True, eq=False)
class FeatureStateSolver:
    """L-BFGS over feature states (Wang et al. 2019, Eq. 14-19). A likelihood should be among the terms.

    The search starts from the last window's features and their zero-noise rollout, whose contact bits are kept.
    """

    scale: Float[Tensor, " continuous"]
    """Physical size of one unit of each feature: the prior's standard deviations."""
    centre: Float[Tensor, " continuous"]
    """Features of unknowns 0, physical units: the prior's means."""
    lbfgs: LbfgsSettings = field(default_factory=lambda: LbfgsSettings(max_iterations=150))
    """Settings of L-BFGS in one window."""
    budget: Budget = field(default_factory=lambda: Budget(evaluations=160))
    """Budget of one window."""

    def __call__(self, request: WindowRequest) -> SolvedWindow:
        """Solve one window; the start stays where nothing finite is found."""
        meter = Meter(self.budget.within(request.seconds))
        features = _continue_features(request.context, request.warm_start)
        bits = LAYOUT.pick(features, "contacts") > 0.5
        heels = request.context.plan_heels(features, bits)
        states = FeatureStates(request.context, self.scale, self.centre, bits, heels)
        return minimise_window(states, request.terms, states.from_features(features), self.lbfgs, meter)


def _continue_features(context: WindowContext, warm_start: Tensor) -> Float[Tensor, "1 frames size"]:
    """Return the last window's features and the prior's zero-noise rollout after them."""
    known = warm_start[: context.frames].unsqueeze(0)
    state = replay(context.prior, known[0], context.prior_state) if len(warm_start) else context.prior_state
    noise = warm_start.new_zeros(1, context.frames - known.shape[1], LAYOUT.continuous)
    with torch.no_grad():
        beyond, _ = context.prior.rollout(state, noise, context.prior.plan(state, noise))
    return torch.cat([known, beyond], dim=1) if len(warm_start) else beyond
