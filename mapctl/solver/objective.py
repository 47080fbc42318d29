"""The MAP objective of one window: unknowns to a trial, terms to energies, autograd to the gradient (Eq. 19).

The density offers a rollout (and, on the fast path, its hand-written pullback behind autograd); a term offers an energy
on the trial's quantities. No piece here knows a network, and no network knows a term.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.solver.result import Ledger, LedgerEntry
from mapctl.terms.base import Term
from mapctl.trial import Trial


@dataclass(frozen=True, eq=False)
class Objective:
    """Energy of a batch of unknown vectors."""

    build: Callable[[Float[Tensor, "batch unknowns"]], Trial]
    """Unknowns to the trial; differentiable."""
    terms: Sequence[Term]
    """Summed over, and over frames."""

    def energy(self, unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
        """Total nats of each candidate."""
        trial = self.build(unknowns)
        total = self.terms[0](trial)
        for term in self.terms[1:]:
            total = total + term(trial)
        return total.sum(-1)

    def energy_and_gradient(self, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Nats (batch,) and their gradient (batch, unknowns); candidates are independent of each other."""
        unknowns = unknowns.detach().requires_grad_(True)
        energy = self.energy(unknowns)
        (gradient,) = torch.autograd.grad(energy.sum(), unknowns)
        return energy.detach(), gradient

    def ledger_of(self, trial: Trial) -> Ledger:
        """By term, the energies and residuals of a trial of one candidate."""
        with torch.no_grad():
            return Ledger(tuple(LedgerEntry(t.name, t.unit, t(trial)[0], t.residual(trial)[0]) for t in self.terms))
