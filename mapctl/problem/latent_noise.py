"""Unknowns that are the noise of a rollout: x = mu_k + sigma_k d, components k and contact bits fixed by a plan."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext
from mapctl.protocols import DiscreteChoices
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class LatentNoise:
    """Unknowns are the standard normal numbers d of a rollout, one batch row a candidate."""

    context: WindowContext
    """What is known before the window."""
    plan: DiscreteChoices
    """Components and contact bits of each frame."""

    @staticmethod
    def from_unknowns(context: WindowContext, unknowns: Float[Tensor, "batch unknowns"]) -> "LatentNoise":
        """Plan the likeliest components and contact bits along the rollout of the unknowns."""
        noise = torch.unflatten(unknowns.detach(), -1, (context.frames, LAYOUT.continuous))
        return LatentNoise(context, context.prior.plan(context.expand_state(len(noise)), noise))

    @staticmethod
    def extend(warm_start: Float[Tensor, "ahead width"], frames: int) -> Float[Tensor, "1 unknowns"]:
        """Return the last window's noise, and zero noise (the prior's plain continuation) beyond it."""
        noise = warm_start.new_zeros(frames, LAYOUT.continuous)
        noise[: len(warm_start)] = warm_start[:frames]
        return noise.flatten().unsqueeze(0)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trials of the noise by a rollout of the density; differentiable."""
        context = self.context
        noise = torch.unflatten(unknowns, -1, (context.frames, LAYOUT.continuous))
        batch = len(noise)
        plan = DiscreteChoices(self.plan.component.expand(batch, -1), self.plan.contacts.expand(batch, -1, -1))
        features, log_density = context.prior.rollout(context.expand_state(batch), noise, plan)
        return context.build_trial(features, plan.contacts, noise=noise, log_density=log_density)

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """Return the noise by frame."""
        return torch.unflatten(unknowns[0], -1, (self.context.frames, LAYOUT.continuous))
