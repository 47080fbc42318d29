"""The MAP objective of one window: unknowns to a trial, terms to energies, autograd to the gradient (Eq. 19).

The density offers a rollout (and, on the fast path, its hand-written pullback behind autograd); a term offers an energy
on the trial's quantities. No piece here knows a network, and no network knows a term.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.problem.ledger import Ledger, LedgerEntry
from mapctl.solver.gradient import differentiate
from mapctl.terms.base import Term
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Objective:
    """Energy of a batch of unknown vectors."""

    build: Callable[[Float[Tensor, "batch unknowns"]], Trial]
    """Unknowns to the trial; differentiable."""
    terms: Sequence[Term]
    """Summed over, and over frames."""

    def energy(self, unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
        """Total nats of each candidate."""
        return self._sum_terms(self.build(unknowns)).sum(-1)

    def _sum_terms(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        total = check_shape(self.terms[0], "energy", self.terms[0](trial), trial)
        for term in self.terms[1:]:
            total = total + check_shape(term, "energy", term(trial), trial)
        return total

    def energy_and_gradient(self, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Nats (batch,) and their gradient (batch, unknowns); candidates are independent of each other.

        RequestError that names the term where one is not finite though the motion is: then the term is at fault.
        """
        energy, gradient = differentiate(self.energy)(unknowns)
        if not bool(torch.isfinite(energy.sum() + gradient.sum())):
            self._raise_for_bad_term(unknowns.detach().requires_grad_(True))
        return energy, gradient

    def _raise_for_bad_term(self, unknowns: Tensor) -> None:
        """Find the term that is not finite, one after the other; says nothing where the motion is none either."""
        for term in self.terms:
            trial = self.build(unknowns)
            if not _is_plausible(trial):
                return
            energy = term(trial)
            _check_finite(term, "energy", energy)
            if energy.requires_grad:
                (gradient,) = torch.autograd.grad(energy.sum(), unknowns, allow_unused=True)
                if gradient is not None:
                    _check_finite(term, "gradient", gradient)

    def build_ledger(self, trial: Trial) -> Ledger:
        """By term, the energies and residuals of a trial of one candidate."""
        with torch.no_grad():
            return Ledger(tuple(_build_entry(term, trial) for term in self.terms))


_PLAUSIBLE_LIMIT = 1e4  # metres or radians: a motion that a search has thrown this far says nothing of a term


def check_shape(term: Term, what: str, values: Any, trial: Trial) -> Float[Tensor, "batch frames"]:
    """What a term gave, if it has a number for each candidate and frame; RequestError that names the term if not."""
    wanted = tuple(trial.features.shape[:-1])
    got = tuple(values.shape) if torch.is_tensor(values) else None
    if got == wanted:
        return values
    told = f"shape {list(got)}" if got is not None else f"a {type(values).__name__}"
    article = "an" if what == "energy" else "a"
    raise RequestError(
        f"the term {term.name!r} gave {article} {what} of {told}; expected a tensor of shape"
        f" {list(wanted)}: candidates, frames"
    )


def _build_entry(term: Term, trial: Trial) -> LedgerEntry:
    energy = check_shape(term, "energy", term(trial), trial)
    residual = check_shape(term, "residual", term.residual(trial), trial)
    if _is_plausible(trial):
        _check_finite(term, "residual", residual)
    return LedgerEntry(term.name, term.unit, energy[0], residual[0])


def _is_plausible(trial: Trial) -> bool:
    made = [trial.features] if trial.noise is None else [trial.features, trial.noise]
    return all(bool((values.detach().abs() < _PLAUSIBLE_LIMIT).all()) for values in made)


def _check_finite(term: Term, what: str, values: Tensor) -> None:
    if bool(torch.isfinite(values).all()):
        return
    bad = int((~torch.isfinite(values)).nonzero()[0, -1])
    where = "" if what == "gradient" else f", first in frame {bad} of its window"
    raise RequestError(
        f"the term {term.name!r} gave {'an' if what == 'energy' else 'a'} {what} that is not finite"
        f" for a motion that is{where}"
    )
