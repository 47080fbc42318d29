"""The MAP objective of one window: unknowns to a trial, terms to energies, and back to the gradient (Wang et al. 2019,
Eq. 19).

The torch form is the specification: a rollout and energies on the trial's quantities, differentiated by autograd. The
terms of following and steering have gradients of their own, which reach the unknowns by the parametrisation's adjoint;
other terms join them by autograd on the trial. Terms and networks do not depend on each other.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.problem.solution import Ledger, LedgerEntry
from mapctl.solver.lbfgs import differentiate
from mapctl.terms.base import DifferentiatedTerm, Term, TrialGradient
from mapctl.terms.trial import Trial


@runtime_checkable
class Parametrisation(Protocol):
    """Unknowns of one window, batch first."""

    @abstractmethod
    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """Build the trial of each candidate; differentiable."""
        ...

    def build_detached(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial | None:
        """Build the trials of `build` without a graph, with their world poses, for `pull_back`. Default: None, autograd
        serves."""
        return None

    def pull_back(self, trial: Trial, gradient: TrialGradient) -> Float[Tensor, "batch unknowns"]:
        """Return the gradient on the unknowns of the trial that `build_detached` built last."""
        raise TypeError(f"{type(self).__name__} has no gradient of its own")


@dataclass(frozen=True, eq=False)
class Objective:
    """Energy of a batch of unknown vectors. A faulty term is named by a RequestError."""

    build: Callable[[Float[Tensor, "batch unknowns"]], Trial]
    """Unknowns to the trial; differentiable."""
    terms: Sequence[Term]
    """Terms whose energies are summed, over frames too."""
    adjoint: Parametrisation | None = None
    """Parametrisation that differentiates by hand what it builds; None: autograd does all."""

    @staticmethod
    def of(unknowns: Parametrisation, terms: Sequence[Term]) -> "Objective":
        """Return the objective of terms over a parametrisation, differentiated by hand as far as that can be."""
        return Objective(unknowns.build, terms, unknowns)

    def energy(self, unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
        """Total nats of each candidate; RequestError where a term gives another shape than a number a frame."""
        return _sum_terms(self.terms, self.build(unknowns)).sum(-1)

    def energy_and_gradient(self, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Nats (batch,) and their gradient (batch, unknowns); candidates are independent of each other.

        RequestError as in `energy`, and where a term is not finite, or its gradient, for a motion that is.
        """
        trial = None if self.adjoint is None else self.adjoint.build_detached(unknowns)
        if self.adjoint is None or trial is None:
            energy, gradient = differentiate(self.energy)(unknowns)
        else:
            on_trial, (by_hand, others) = TrialGradient.zeros(trial), self._parted_terms
            nats = np.zeros(on_trial.log_density.shape)
            for term in by_hand:
                nats += term.add_gradient(trial, on_trial)
            if others:
                found, slopes = _differentiate_terms(others, trial)
                nats += found.detach().double().numpy()
                for name, slope in slopes.items():
                    getattr(on_trial, name)[...] += slope.numpy()
            energy = torch.as_tensor(nats.sum(axis=-1)).to(unknowns.dtype)
            gradient = self.adjoint.pull_back(trial, on_trial)
        if not bool(torch.isfinite(energy.sum() + gradient.sum())):
            self._raise_for_bad_term(unknowns)
        return energy, gradient

    def build_detached(self, unknowns: Tensor) -> Trial:
        """Build the trials of unknowns without a gradient."""
        trial = None if self.adjoint is None else self.adjoint.build_detached(unknowns)
        if trial is not None:
            return trial
        with torch.no_grad():
            return self.build(unknowns)

    @cached_property
    def _parted_terms(self) -> tuple[list[DifferentiatedTerm], list[Term]]:
        """The terms that have a gradient of their own, and the others."""
        by_hand = [term for term in self.terms if isinstance(term, DifferentiatedTerm)]
        return by_hand, [term for term in self.terms if not isinstance(term, DifferentiatedTerm)]

    def _raise_for_bad_term(self, unknowns: Tensor) -> None:
        """Raise for the first term that is not finite; do nothing where the motion itself is not."""
        with torch.no_grad():
            trial = self.build(unknowns)
        if _is_plausible(trial):
            for term in self.terms:
                energy, slopes = _differentiate_terms([term], trial)
                _check_finite(term, "energy", energy)
                for slope in slopes.values():
                    _check_finite(term, "gradient", slope.sum(-1) if slope.ndim > 2 else slope)

    def build_ledger(self, trial: Trial) -> Ledger:
        """By term, the energies and residuals of a trial of one candidate; RequestError where one of them has another
        shape, or is not finite for a motion that is."""
        entries, plausible = list[LedgerEntry](), _is_plausible(trial)
        with torch.no_grad():
            for term in self.terms:
                energy, residual = _evaluate(term, "energy", trial), _evaluate(term, "residual", trial)
                if plausible:
                    _check_finite(term, "energy", energy)
                    _check_finite(term, "residual", residual)
                entries.append(LedgerEntry(term.name, term.unit, energy[0], residual[0]))
        return Ledger(tuple(entries))


_PLAUSIBLE_LIMIT = 1e4  # metres or radians: a motion that a search has thrown this far is no term's fault


def _sum_terms(terms: Sequence[Term], trial: Trial) -> Float[Tensor, "batch frames"]:
    total = _evaluate(terms[0], "energy", trial)
    for term in terms[1:]:
        total = total + _evaluate(term, "energy", trial)
    return total


def _differentiate_terms(terms: Sequence[Term], trial: Trial) -> tuple[Tensor, dict[str, Tensor]]:
    """Energies of terms and their gradient on the parts of a trial, by autograd; none where they have no graph."""
    leaves = {name: values.detach().requires_grad_(True) for name, values in _parts(trial).items()}
    energy = _sum_terms(terms, replace(trial, **leaves, world_poses=None))
    if not energy.requires_grad:
        return energy, {}
    slopes = torch.autograd.grad(energy.sum(), list(leaves.values()), materialize_grads=True)
    return energy, dict(zip(leaves, slopes, strict=True))


def _parts(trial: Trial) -> dict[str, Tensor]:
    """The features, and the noise and the log density where there are any."""
    parts = {"features": trial.features, "noise": trial.noise, "log_density": trial.log_density}
    return {name: values for name, values in parts.items() if values is not None}


def _is_plausible(trial: Trial) -> bool:
    parts = _parts(trial)
    log_density = parts.pop("log_density", torch.zeros(()))
    within = all(bool((values.abs() < _PLAUSIBLE_LIMIT).all()) for values in parts.values())
    return within and bool(torch.isfinite(log_density).all())


def _evaluate(term: Term, what: str, trial: Trial) -> Float[Tensor, "batch frames"]:
    """Return a term's energy or residual; RequestError for another shape. An error of the term gets a note with its
    name."""
    values, expected = _call(term, what, trial), trial.features.shape[:-1]
    if isinstance(values, Tensor) and values.shape == expected:
        return values
    found = f"shape {list(values.shape)}" if isinstance(values, Tensor) else f"a {type(values).__name__}"
    raise RequestError(
        f"the {what} of the term {term.name!r} has {found}; expected {list(expected)}: candidates, frames"
    )


def _call(term: Term, what: str, trial: Trial) -> object:
    try:
        return term(trial) if what == "energy" else term.residual(trial)
    except Exception as error:
        error.add_note(f"while the term {term.name!r} computed its {what}")
        raise


def _check_finite(term: Term, what: str, values: Float[Tensor, "batch frames"]) -> None:
    bad = (~torch.isfinite(values)).nonzero()
    if len(bad):
        frame = int(bad[0, -1])
        raise RequestError(
            f"the {what} of the term {term.name!r} is not finite for a motion that is, in frame {frame} of its window"
        )
