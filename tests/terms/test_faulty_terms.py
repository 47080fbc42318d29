"""A term that is wrong is named, with what is wrong of it: the user's own and the library's."""

from dataclasses import dataclass, fields, replace

import pytest
import torch
from catalogue import FRAMES, TERMS, trial

from mapctl.errors import RequestError
from mapctl.problem.objective import Objective
from mapctl.terms import Keyframe, LatentPrior, Likelihood


@dataclass(frozen=True)
class Own:
    """Gives what it is told to, of the noise."""

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
    wrong, told = SHAPES[name]
    with pytest.raises(RequestError, match=f"the term 'own' gave an energy of .*{told}.*expected.*\\[2, 12\\]"):
        objective(Own(wrong)).energy_and_gradient(START)
    with pytest.raises(RequestError, match=f"the term 'own' gave a residual of .*{told}"):
        objective(Own(fine, wrong)).build_ledger(BASE)


@pytest.mark.parametrize("what", NONE)
def test_what_is_not_finite_is_named(what):
    with pytest.raises(RequestError, match=f"the term 'own' gave an? {what} that is not finite .* in frame 0"):
        objective(Own(NONE[what])).energy_and_gradient(START)


@pytest.mark.parametrize("what", ["energy", "residual"])
def test_the_ledger_names_it_where_no_energy_was_evaluated_before(what):
    wrong = Own(NONE["energy"]) if what == "energy" else Own(fine, NONE["energy"])
    with pytest.raises(RequestError, match=f"the term 'own' gave an? {what} that is not finite"):
        objective(wrong).build_ledger(BASE)


def test_the_one_of_many_is_named_and_its_frame():
    def late(noise):
        return torch.where(torch.arange(FRAMES) == 5, torch.nan, 1.0) * noise.sum(-1)

    terms = Own(fine, name="first"), Own(late, name="second"), Own(fine, name="third")
    with pytest.raises(RequestError, match=r"the term 'second' gave an energy .* in frame 5"):
        objective(*terms).energy_and_gradient(START)


def without_numbers(term):
    """The library's term with sigmas, lengths and temperatures that are no numbers."""
    numbers = [field.name for field in fields(term) if isinstance(getattr(term, field.name), float)]
    return replace(term, **dict.fromkeys(numbers, torch.nan))


@pytest.mark.parametrize("name", TERMS)
def test_the_librarys_own_are_named_too(name):
    unusual = {"path": {"sigma_slow": torch.nan}, "travel": {"sigma_direction": torch.nan}}  # others shape its smoother
    term = TERMS[name]
    term = replace(term, **unusual[term.name]) if term.name in unusual else without_numbers(term)
    with pytest.raises(RequestError, match=f"the term {term.name!r} gave an energy that is not finite"):
        objective(term).energy_and_gradient(START)
    with pytest.raises(RequestError, match=f"the term {term.name!r} gave an? (energy|residual) that is not finite"):
        objective(term).build_ledger(BASE)


def test_targets_of_other_frames_name_their_term():
    """The error is that of torch, which knows no term; the note does."""
    short = objective(Keyframe(torch.zeros(5, 21, 3), torch.ones(5, 21, dtype=torch.bool)))
    for call in (lambda: short.energy_and_gradient(START), lambda: short.build_ledger(BASE)):
        with pytest.raises(RuntimeError, match="size of tensor") as caught:
            call()
        assert caught.value.__notes__[0] == "while the term 'keyframe' computed its energy"


def test_a_motion_that_is_not_finite_is_no_terms_fault():
    """A search may step far beyond what is a motion; that is the solver's to mend."""
    energy, _ = objective(Own(fine)).energy_and_gradient(START * 0 + torch.inf)
    assert not bool(torch.isfinite(energy).all())


def test_a_density_that_breaks_down_is_no_terms_fault():
    silent = replace(BASE, log_density=torch.full_like(BASE.log_density, torch.nan))
    energy, _ = objective(Likelihood(), base=silent).energy_and_gradient(START)
    assert bool(torch.isnan(energy).all())


def test_a_rollout_without_a_gradient_is_no_terms_fault():
    def build(unknowns):
        noise = unknowns.unflatten(-1, BASE.noise.shape[1:])
        return replace(BASE, noise=noise.square().sqrt())  # 0, with no slope there

    _, gradient = Objective(build, (Own(fine), Own(lambda noise: noise.sum(-1)))).energy_and_gradient(START)
    assert bool(torch.isnan(gradient).all())
