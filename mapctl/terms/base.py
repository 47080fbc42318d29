"""The protocol of a term: an energy for every frame of every candidate, and a residual in a physical unit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mapctl.terms.trial import Trial

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TrialGradient:
    """Gradients, nats per unit of the quantity; terms add to the arrays in place."""

    features: Array
    """(batch, frames, size): on the features, beside what reaches them through the poses in the world."""
    noise: Array
    """(batch, frames, width): on the noise."""
    log_density: Array
    """(batch, frames): on the log density."""
    root_xz_world: Array
    """(batch, frames, 2): on the ground projection of the hips, beside what reaches it through the joints."""
    heading: Array
    """(batch, frames): on the heading of the hips, likewise."""
    joints_world: Array
    """(batch, frames, joints, 3): on the world joint positions."""
    heels_world: Array
    """(batch, frames, 2, 3): on the world positions of the heels."""

    @staticmethod
    def zeros(trial: Trial) -> "TrialGradient":
        """Zeros for a trial that has noise."""
        batch, frames, size = trial.features.shape
        shapes = ((size,), trial.require_noise().shape[2:], (), (2,), (), (trial.skeleton.num_joints, 3), (2, 3))
        return TrialGradient(*(np.zeros((batch, frames, *shape), np.float32) for shape in shapes))


@runtime_checkable
class Term(Protocol):
    """One thing that is wanted of a motion. Energies are negative log likelihoods (nats), so that sigmas in physical
    units are the only weights; constants may be left out. Candidates are independent of each other."""

    @property
    def name(self) -> str:
        """Name in the ledger; different among the terms of one problem."""
        ...

    @property
    def unit(self) -> str:
        """Unit of the residual."""
        ...

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Compute the energies, nats; differentiable once."""
        ...

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Compute how far each frame is from what is wanted, in the term's unit."""
        ...


@runtime_checkable
class DifferentiatedTerm(Term, Protocol):
    """A term with a gradient of its own, which spares a search most of autograd's cost. `__call__` stays the
    specification. A term needs none: autograd serves where there is none."""

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        ...


@dataclass(frozen=True, eq=False)
class ViewedTerm:
    """A term that is shown another view of each trial: at another size, or elsewhere."""

    term: Term
    """The term."""
    view: Callable[[Trial], Trial]
    """The view of a trial, differentiable in its features."""
    residual_scale: float = 1.0
    """Factor from the residual in that view to the one that the ledger takes."""

    @property
    def name(self) -> str:
        """Name of the term."""
        return self.term.name

    @property
    def unit(self) -> str:
        """Unit of the residual."""
        return self.term.unit

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Compute the term's energies of the view, nats."""
        return self.term(self.view(trial))

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Compute the term's residual of the view, times `residual_scale`."""
        return self.residual_scale * self.term.residual(self.view(trial))


def length(vectors: Float[Tensor, "*batch dims"]) -> Float[Tensor, "*batch"]:
    """Return Euclidean lengths; the gradient at length 0 is 0. Typed, as `Tensor.norm` is not."""
    return vectors.norm(dim=-1)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
