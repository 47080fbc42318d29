"""Unknowns that are the features themselves, scored with teacher forcing."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext, _expand_state
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class FeatureStates:
    """Unknowns are features (in units of `scale`) and the noise on the network's input, side by side."""

    context: WindowContext
    """Before the window."""
    scale: Float[Tensor, " continuous"]
    """Physical size of one unit of each feature: the prior's standard deviations."""
    centre: Float[Tensor, " continuous"]
    """The prior's means."""
    contacts: Bool[Tensor, "1 frames 2"]
    """Fixed bits."""
    input_noise: float = 0.05
    """Standard deviation of the input noise, normalised units: what one unit of its unknowns is worth."""

    def from_features(self, features: Float[Tensor, "batch frames size"]) -> Float[Tensor, "batch unknowns"]:
        """Unknowns of a motion without input noise."""
        states = (features[..., : LAYOUT.continuous] - self.centre) / self.scale
        return torch.cat([states.flatten(1), torch.zeros_like(states).flatten(1)], dim=-1)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Score the states with teacher forcing."""
        context, half = self.context, unknowns.shape[-1] // 2
        shape = (context.frames, LAYOUT.continuous)
        states, noise = unknowns[:, :half].unflatten(-1, shape), unknowns[:, half:].unflatten(-1, shape)
        bits = self.contacts.expand(len(states), -1, -1).to(states.dtype)
        features = torch.cat([states * self.scale + self.centre, bits], dim=-1)
        inputs = features[..., : LAYOUT.continuous] + noise * self.input_noise * self.scale
        seen = torch.cat([inputs, bits], dim=-1)
        density = context.density.log_prob(features, _expand_state(context.state, len(states)), inputs=seen)
        return context.trial(features, noise, density, self.contacts.expand(len(states), -1, -1))
