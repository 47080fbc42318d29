"""The two kinds of unknowns of a window. Only here are unknowns scaled; everything else is physical.

`Latents`: the noise of a rollout, x = mu_k + sigma_k d, with components and contact bits fixed by a plan. `States`: the
features themselves in normalised units, scored with teacher forcing (Eq. 14-15), and the noise on the network's input
(Eq. 16). Section 11 of the design found the first to converge several times faster; the ablation reruns the comparison.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.features import LAYOUT, PRIOR_FPS, Place
from mapctl.protocols import Density, Plan
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Context:
    """What is known before the window."""

    density: Density
    """The prior."""
    state: Any
    """Its state after the committed frames; batch of one, or one for each candidate."""
    place: Place
    """Of the last committed frame."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last committed frames, metres."""
    frames: int
    """Of the window."""
    skeleton: Skeleton = CANONICAL
    """Bones of the character."""
    fps: float = PRIOR_FPS
    """Frames per second."""

    def trial(self, features: Tensor, noise: Tensor, density: Tensor, contacts: Tensor) -> Trial:
        """A trial in this context."""
        planted = LAYOUT.pick(self.state.previous, "contacts") > 0.5
        return Trial(features, self.place, noise, density, contacts, self.before, self.skeleton, self.fps, planted)


@dataclass(frozen=True, eq=False)
class Latents:
    """Unknowns are the numbers d of a rollout, one batch row a candidate."""

    context: Context
    """Before the window."""
    plan: Plan
    """Components and contact bits of each frame."""

    @staticmethod
    def planned(context: Context, unknowns: Float[Tensor, "batch unknowns"]) -> "Latents":
        """With the likeliest plan along the rollout of the given unknowns."""
        noise = unknowns.detach().unflatten(-1, (context.frames, LAYOUT.continuous))
        return Latents(context, context.density.plan(_spread(context.state, len(noise)), noise))

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Roll the density out."""
        context = self.context
        noise = unknowns.unflatten(-1, (context.frames, LAYOUT.continuous))
        batch = len(noise)
        plan = Plan(self.plan.component.expand(batch, -1), self.plan.contacts.expand(batch, -1, -1))
        features, density = context.density.rollout(_spread(context.state, batch), noise, plan)
        return context.trial(features, noise, density, plan.contacts)


@dataclass(frozen=True, eq=False)
class States:
    """Unknowns are features (in units of `scale`) and the noise on the network's input, side by side."""

    context: Context
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
        density = context.density.log_prob(features, _spread(context.state, len(states)), inputs=seen)
        return context.trial(features, noise, density, self.contacts.expand(len(states), -1, -1))


def _spread(state: Any, batch: int) -> Any:
    """The state for a batch of candidates."""
    return state if state.batch == batch else state.repeat(batch)
