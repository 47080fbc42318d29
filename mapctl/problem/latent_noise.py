"""The two kinds of unknowns of a window. Only here are unknowns scaled; everything else is physical.

`LatentNoise`: the noise of a rollout, x = mu_k + sigma_k d, with components and contact bits fixed by a plan.
`FeatureStates`: the features themselves in normalised units, scored with teacher forcing (Eq. 14-15), and the noise on
the network's input (Eq. 16). Section 11 of the design found the first to converge several times faster; the ablation
reruns the comparison.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import WindowContext, _expand_state
from mapctl.protocols import DiscreteChoices
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class LatentNoise:
    """Unknowns are the numbers d of a rollout, one batch row a candidate."""

    context: WindowContext
    """Before the window."""
    plan: DiscreteChoices
    """Components and contact bits of each frame."""

    @staticmethod
    def from_unknowns(context: WindowContext, unknowns: Float[Tensor, "batch unknowns"]) -> "LatentNoise":
        """With the likeliest plan along the rollout of the given unknowns."""
        noise = unknowns.detach().unflatten(-1, (context.frames, LAYOUT.continuous))
        return LatentNoise(context, context.density.plan(_expand_state(context.state, len(noise)), noise))

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Roll the density out."""
        context = self.context
        noise = unknowns.unflatten(-1, (context.frames, LAYOUT.continuous))
        batch = len(noise)
        plan = DiscreteChoices(self.plan.component.expand(batch, -1), self.plan.contacts.expand(batch, -1, -1))
        features, density = context.density.rollout(_expand_state(context.state, batch), noise, plan)
        return context.trial(features, noise, density, plan.contacts)
