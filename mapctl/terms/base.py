"""The protocol of a term: an energy for every frame of every candidate, and a residual in a physical unit."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mapctl.terms.adjoints.gradient import TrialGradient
from mapctl.terms.trial import Trial


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
