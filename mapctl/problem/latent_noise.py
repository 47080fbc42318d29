"""The two kinds of unknowns of a window. Only here are unknowns scaled; everything else is physical.

`Latents`: the noise of a rollout, x = mu_k + sigma_k d, with components and contact bits fixed by a plan. `States`: the
features themselves in normalised units, scored with teacher forcing (Eq. 14-15), and the noise on the network's input
(Eq. 16). Section 11 of the design found the first to converge several times faster; the ablation reruns the comparison.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mapctl.features import LAYOUT
from mapctl.problem.context import Context, _spread
from mapctl.protocols import Plan
from mapctl.terms.trial import Trial


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
