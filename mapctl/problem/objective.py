"""The MAP objective of one window: unknowns to a trial, terms to energies, and back to the gradient (Wang et al. 2019,
Eq. 19).

The torch form is the specification: a rollout and energies on the trial's quantities, differentiated by autograd. The
terms of following and steering have gradients of their own, which reach the unknowns by the parametrisation's adjoint;
other terms join them by autograd on the trial. Nothing here knows a network, and no network knows a term.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

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


@dataclass(frozen=True, eq=False)
class Objective:
    """Energy of a batch of unknown vectors. A term that is at fault is named by a RequestError."""

    build: Callable[[Float[Tensor, "batch unknowns"]], Trial]
    """Unknowns to the trial; differentiable."""
    terms: Sequence[Term]
    """Terms whose energies are summed, over frames too."""
    adjoint: AdjointParametrisation | None = None
    """Parametrisation that differentiates by hand; None: autograd does all."""

    @staticmethod
    def of(unknowns: Parametrisation, terms: Sequence[Term]) -> "Objective":
        """Return the objective of terms over a parametrisation, differentiated by hand as far as that can be."""
        adjoint = unknowns if isinstance(unknowns, AdjointParametrisation) else None
        return Objective(unknowns.build, terms, adjoint)

    def energy(self, unknowns: Float[Tensor, "batch unknowns"]) -> Float[Tensor, " batch"]:
        """Total nats of each candidate; RequestError where a term gives another shape than a number a frame."""
        return _sum_terms(self.terms, self.build(unknowns)).sum(-1)

    def energy_and_gradient(self, unknowns: Tensor) -> tuple[Tensor, Tensor]:
        """Nats (batch,) and their gradient (batch, unknowns); candidates are independent of each other.

        RequestError as in `energy`, and where a term is not finite, or its gradient, for a motion that is.
        """
        energy, gradient = self._differentiate_by_hand(unknowns) or differentiate(self.energy)(unknowns)
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

    def _differentiate_by_hand(self, unknowns: Tensor) -> tuple[Tensor, Tensor] | None:
        """Energies and gradient through the parametrisation's own adjoint; None where it has none for these."""
        trial = None if self.adjoint is None else self.adjoint.build_detached(unknowns)
        if self.adjoint is None or trial is None:
            return None
        gradient, (by_hand, others) = TrialGradient.zeros(trial), self._parted_terms
        energy = np.zeros(gradient.log_density.shape)
        for term in by_hand:
            energy += term.add_gradient(trial, gradient)
        if others:
            energy += _add_gradient_by_autograd(others, trial, gradient)
        total = torch.as_tensor(energy.sum(axis=-1)).to(unknowns.dtype)
        return total, self.adjoint.pull_back(trial, gradient)

    @cached_property
    def _parted_terms(self) -> tuple[list[DifferentiatedTerm], list[Term]]:
        """The terms that have a gradient of their own, and the others."""
        by_hand = [term for term in self.terms if isinstance(term, DifferentiatedTerm)]
        return by_hand, [term for term in self.terms if not isinstance(term, DifferentiatedTerm)]

    def _raise_for_bad_term(self, unknowns: Tensor) -> None:
        """Find the first term that is not finite; do nothing where the motion or its log density is not finite."""
        with torch.no_grad():
            trial = self.build(unknowns)
        if not _is_plausible(trial):
            return
        for term in self.terms:
            # What the trial itself is made of: how it comes about is no term's fault.
            leaves = {name: values.detach().requires_grad_(True) for name, values in _parts(trial).items()}
            energy = _evaluate(term, "energy", replace(trial, **leaves, world_poses=None))
            _check_finite(term, "energy", energy)
            if energy.requires_grad:
                slopes = torch.autograd.grad(energy.sum(), list(leaves.values()), materialize_grads=True)
                for slope in slopes:
                    _check_finite(term, "gradient", slope.sum(-1) if slope.ndim > 2 else slope)

    def build_ledger(self, trial: Trial) -> Ledger:
        """By term, the energies and residuals of a trial of one candidate; RequestError where one of them has another
        shape, or is not finite for a motion that is."""
        with torch.no_grad():
            return Ledger(tuple(_build_entry(term, trial) for term in self.terms))


_PLAUSIBLE_LIMIT = 1e4  # metres or radians: a motion that a search has thrown this far says nothing of a term


def _sum_terms(terms: Sequence[Term], trial: Trial) -> Float[Tensor, "batch frames"]:
    total = _evaluate(terms[0], "energy", trial)
    for term in terms[1:]:
        total = total + _evaluate(term, "energy", trial)
    return total


def _add_gradient_by_autograd(terms: Sequence[Term], trial: Trial, gradient: TrialGradient) -> np.ndarray:
    """Add the gradient of terms without one of their own; return their energies."""
    leaves = {name: values.detach().requires_grad_(True) for name, values in _parts(trial).items()}
    energy = _sum_terms(terms, replace(trial, **leaves, world_poses=None))
    if energy.requires_grad:
        slopes = torch.autograd.grad(energy.sum(), list(leaves.values()), materialize_grads=True)
        for name, slope in zip(leaves, slopes, strict=True):
            getattr(gradient, name)[...] += slope.numpy()
    return energy.detach().double().numpy()


def _parts(trial: Trial) -> dict[str, Tensor]:
    """What terms differentiate: the features, and the noise and the log density where there are any."""
    parts = {"features": trial.features, "noise": trial.noise, "log_density": trial.log_density}
    return {name: values for name, values in parts.items() if values is not None}


def _is_plausible(trial: Trial) -> bool:
    parts = _parts(trial)
    log_density = parts.pop("log_density", torch.zeros(()))
    within = all(bool((values.abs() < _PLAUSIBLE_LIMIT).all()) for values in parts.values())
    return within and bool(torch.isfinite(log_density).all())


def _evaluate(term: Term, what: Literal["energy", "residual"], trial: Trial) -> Float[Tensor, "batch frames"]:
    """A term's energy or residual; what the term raises is raised on, with a note that names it."""
    try:
        values = term(trial) if what == "energy" else term.residual(trial)
    except Exception as error:
        error.add_note(f"while the term {term.name!r} computed its {what}")
        raise
    return _check_shape(term, what, values, trial)


def _check_shape(term: Term, what: str, values: object, trial: Trial) -> Float[Tensor, "batch frames"]:
    """The values, if they are a number for each candidate and frame; RequestError if not."""
    expected = trial.features.shape[:-1]
    if isinstance(values, Tensor) and values.shape == expected:
        return values
    found = f"shape {list(values.shape)}" if isinstance(values, Tensor) else f"a {type(values).__name__}"
    raise RequestError(
        f"the term {term.name!r} gave {_with_article(what)} of {found}; expected a tensor of shape"
        f" {list(expected)}: candidates, frames"
    )


def _build_entry(term: Term, trial: Trial) -> LedgerEntry:
    energy, residual = _evaluate(term, "energy", trial), _evaluate(term, "residual", trial)
    if _is_plausible(trial):
        _check_finite(term, "energy", energy)
        _check_finite(term, "residual", residual)
    return LedgerEntry(term.name, term.unit, energy[0], residual[0])


def _check_finite(term: Term, what: str, values: Float[Tensor, "batch frames"]) -> None:
    if bool(torch.isfinite(values).all()):
        return
    frame = int((~torch.isfinite(values)).nonzero()[0, -1])
    raise RequestError(
        f"the term {term.name!r} gave {_with_article(what)} that is not finite for a motion that is, first in frame"
        f" {frame} of its window"
    )


def _with_article(noun: str) -> str:
    return f"an {noun}" if noun == "energy" else f"a {noun}"
