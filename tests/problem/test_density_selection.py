"""Which density a motion is likelier under, and how far it is trusted."""

import math
from dataclasses import dataclass
from functools import cache

import pytest
import torch
from helpers import tiny_density, walk
from toy_density import ToyDensity, toy_density

from mapctl.features import LAYOUT, encode
from mapctl.problem import density_selection


@dataclass(frozen=True, eq=False)
class Flat(ToyDensity):
    """A density that says the same of every frame."""

    name: str = "flat"
    nats: float = 0.0
    """Standard deviation of a frame, normalised units."""
    std: float = 1.0
    usual: float = 0.0

    @property
    def feature_std(self):
        return torch.full((LAYOUT.size,), self.std)

    @property
    def reference_log_density(self):
        return self.usual

    def log_prob(self, features, state):
        return torch.full(features.shape[:2], self.nats)


def flat(name, nats, std=1.0, usual=0.0, kind=Flat):
    toy = toy_density()
    return kind(toy.initial_states, toy.mean, toy.sigma, name=name, nats=nats, std=std, usual=usual)


@cache
def tiny():
    return tiny_density()


def test_densities_are_compared_in_physical_units():
    """The narrower statistics are worth their logarithm; those of the contact bits count for neither."""
    wide, narrow = flat("wide", 0.0), flat("narrow", -10.0, std=0.5)
    assert density_selection.select_density_for_motion([wide, narrow], walk(20)).density is narrow
    found = density_selection.select_density_for_motion([wide, narrow], walk(20)).nats
    assert found == pytest.approx({"wide": 0.0, "narrow": -10 + LAYOUT.continuous * math.log(2)}, rel=1e-5)


def test_a_density_without_a_finite_answer_is_never_chosen():
    choice = density_selection.select_density_for_motion([flat("lost", math.nan), flat("bad", -1e4)], walk(20))
    assert choice.density.name == "bad"
    lost = density_selection.select_density_for_motion([flat("lost", math.nan)], walk(20))
    assert 0 < lost.weight < 1e-3


@pytest.mark.parametrize(("lacking", "weight"), [(-50.0, 1.0), (0.0, 1.0), (33.0, 0.5), (99.0, 0.25)])
def test_the_weight_falls_with_what_is_lacking(lacking, weight):
    assert density_selection.select_density_for_motion(
        [flat("a", 0.0, usual=lacking)], walk(20)
    ).weight == pytest.approx(weight)


def test_a_blurred_density_is_that_of_a_sum():
    """One Gaussian with independent values: its variances and those of the errors add up."""
    density = tiny_density(components=1)
    features = encode(walk(12))[0].float()[None]
    state, spread = density.start_after(features[:, 0]), 3 * density_selection.proposal_sigma()
    model = density.reference
    with torch.no_grad():
        mixture, _ = model(model.normalise(features[:, :-1]), (state.hidden, state.cell))
        size = LAYOUT.continuous
        sigma = (mixture.log_sigma[..., 0, :].exp().square() + (spread / model.std[:size]).square()).sqrt()
        error = model.normalise(features[:, 1:])[..., :size] - mixture.mean[..., 0, :]
        wanted = torch.distributions.Normal(0.0, sigma).log_prob(error).sum(-1)
        signed = torch.where(features[:, 1:, size:] > 0.5, mixture.contact_logit, -mixture.contact_logit)
        wanted = wanted + torch.nn.functional.logsigmoid(signed).sum(-1)
    assert torch.allclose(density.with_observation_noise(spread).log_prob(features[:, 1:], state), wanted, rtol=1e-4)
