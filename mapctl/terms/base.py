"""What a term is: an energy for every frame of every candidate, and what it measures in physical units."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from mapctl.terms.trial import Trial


@runtime_checkable
class Term(Protocol):
    """Sigmas in physical units are a term's only weights; energies are negative log likelihoods (nats)."""

    @property
    def name(self) -> str:
        """In the ledger."""
        ...

    @property
    def unit(self) -> str:
        """Of the residual."""
        ...

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Energies, nats."""
        ...

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """How far the wish is missed, in the term's unit."""
        ...
