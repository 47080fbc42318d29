"""Parametrisation of a window: the vector of unknowns from which a trial is built. Only unknowns are scaled; all else
is in physical units.

There are two. `LatentNoise`: the noise of a rollout, x = mu_k + sigma_k d, with components and contact bits fixed. It
converges several times faster than the features themselves, scored with teacher forcing (Wang et al. 2019, Eq. 14-16).
`PoseOffsets`: offsets of root and joint angles about a proposed motion, in sigmas.
"""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from mapctl.terms.adjoints.gradient import TrialGradient
from mapctl.terms.trial import Trial


@runtime_checkable
class Parametrisation(Protocol):
    """Unknowns of one window, batch first. Where a search over them starts is for the window's solver to say."""

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trial of each candidate; differentiable."""
        ...

    def warm_start(self, unknowns: Float[Tensor, "1 unknowns"]) -> Float[Tensor, "frames width"]:
        """Return by frame what the solver of a window that overlaps this one may start from."""
        ...


@runtime_checkable
class AdjointParametrisation(Parametrisation, Protocol):
    """A parametrisation that differentiates what it builds by hand, without torch's graph."""

    def build_detached(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial | None:
        """Build the trials of `build` without a graph, with their world poses; None where autograd must serve."""
        ...

    def pull_back(self, trial: Trial, gradient: TrialGradient) -> Float[Tensor, "batch unknowns"]:
        """Return the gradient on the unknowns of the trial that was built last."""
        ...
