"""A term that is wrong is named, with what is wrong of it: the user's own and the library's."""

from dataclasses import dataclass, replace

import pytest
import torch
from catalogue import trial

from mapctl.errors import RequestError
from mapctl.problem.objective import Objective
from mapctl.terms import LatentPrior


@dataclass(frozen=True)
class Own:
    """Return the given value, of the noise."""

    energy: object
    off: object = staticmethod(lambda noise: noise.sum(-1))
    name: str = "own"
    unit: str = "m"

    def __call__(self, trial):
        return self.energy(trial.noise)

    def residual(self, trial):
        return self.off(trial.noise)


BASE = trial(2)


def objective(*terms, base=BASE):
    def build(unknowns):
        return replace(base, noise=unknowns.unflatten(-1, base.noise.shape[1:]))

    return Objective(build, (LatentPrior(), *terms))


START = torch.zeros_like(BASE.noise).flatten(1)
SHAPES = {
    "frames lost": (lambda noise: noise.square().sum((-1, -2)), r"shape \[2\]"),
    "candidates lost": (lambda noise: noise.square().sum(-1)[0], r"shape \[12\]"),
    "one more": (lambda noise: noise.square(), r"shape \[2, 12, "),
    "no tensor": (lambda noise: 1.0, "a float"),
}
NONE = {
    "energy": lambda noise: torch.log(noise.sum(-1) - 1e9),
    "gradient": lambda noise: torch.sqrt(noise.square().sum(-1)),
}


def fine(noise):
    """An energy without fault."""
    return noise.square().sum(-1)


@pytest.mark.parametrize("name", SHAPES)
def test_a_wrong_shape_is_named_with_the_one_expected(name):
    wrong, given = SHAPES[name]
    with pytest.raises(RequestError, match=f"the energy of the term 'own' has .*{given}.*expected.*\\[2, 12\\]"):
        objective(Own(wrong)).energy_and_gradient(START)
    with pytest.raises(RequestError, match=f"the residual of the term 'own' has .*{given}"):
        objective(Own(fine, wrong)).build_ledger(BASE)


@pytest.mark.parametrize("what", NONE)
def test_what_is_not_finite_is_named(what):
    with pytest.raises(RequestError, match=f"the {what} of the term 'own' is not finite .* in frame 0"):
        objective(Own(NONE[what])).energy_and_gradient(START)


def test_a_motion_that_is_not_finite_is_no_terms_fault():
    """A search may step far beyond what is a motion; that is the solver's to mend."""
    energy, _ = objective(Own(fine)).energy_and_gradient(START * 0 + torch.inf)
    assert not bool(torch.isfinite(energy).all())
