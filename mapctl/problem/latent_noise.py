"""Unknowns that are the noise of a rollout: x = mu_k + sigma_k d, with components and contact bits fixed by a plan."""

from dataclasses import dataclass

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
        """With the likeliest plan along the rollout of the given unknowns."""
        noise = unknowns.detach().unflatten(-1, (context.frames, LAYOUT.continuous))
        return LatentNoise(context, context.prior.plan(context.expand_state(len(noise)), noise))

    @staticmethod
    def extend(warm_start: Float[Tensor, "ahead width"], frames: int) -> Float[Tensor, "1 unknowns"]:
        """The last window's noise, and zero noise (the prior's own continuation) beyond it."""
        noise = warm_start.new_zeros(frames, LAYOUT.continuous)
        noise[: len(warm_start)] = warm_start[:frames]
        return noise.flatten().unsqueeze(0)

    def initial(self, warm_start: Float[Tensor, "ahead width"]) -> Float[Tensor, "1 unknowns"]:
        """See `extend`."""
        return LatentNoise.extend(warm_start, self.context.frames)

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Roll the density out."""
        context = self.context
        noise = unknowns.unflatten(-1, (context.frames, LAYOUT.continuous))
        batch = len(noise)
        plan = DiscreteChoices(self.plan.component.expand(batch, -1), self.plan.contacts.expand(batch, -1, -1))
        features, log_density = context.prior.rollout(context.expand_state(batch), noise, plan)
        return context.build_trial(features, plan.contacts, noise=noise, log_density=log_density)

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """The noise by frame."""
        return unknowns[0].unflatten(-1, (self.context.frames, LAYOUT.continuous))
