"""What a window's unknowns are: a vector of numbers that builds a trial. Only here are unknowns scaled; everything else
is physical.

Three kinds implement it. `LatentNoise`: the noise of a rollout, x = mu_k + sigma_k d, with components and contact bits
fixed. `FeatureStates`: the features themselves in normalised units, scored with teacher forcing (Wang et al. 2019, Eq.
14-16). `PoseOffsets`: offsets of root and joint angles about a proposed motion, in sigmas. Rollouts converge several
times faster than feature states: `mapctl bench ablation` reruns the comparison.
"""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from mapctl.terms.trial import Trial


@runtime_checkable
class Parametrisation(Protocol):
    """The unknowns of one window, batch first."""

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """The trial of each candidate; differentiable."""
        ...

    def initial(self, warm_start: Float[Tensor, "ahead width"]) -> Float[Tensor, "1 unknowns"]:
        """Where a search starts, from what the last window found for the first of these frames; empty at the start."""
        ...

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """By frame, what a window that overlaps this one may start from (see `initial`)."""
        ...
