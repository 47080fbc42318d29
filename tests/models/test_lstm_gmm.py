"""The LSTM-GMM against torch.distributions, and its five operations against each other."""

import pytest
import torch
from catalogue import NETWORKS
from helpers import corpus, generator, noise
from torch.distributions import Bernoulli, Categorical, Independent, MixtureSameFamily, MultivariateNormal

from mapctl.features import LAYOUT
from mapctl.protocols import DiscreteChoices

SIZE = LAYOUT.continuous
each_network = pytest.mark.parametrize("kind", NETWORKS)


def clip(batch=2, frames=9, first=20):
    """Frames of the walks, float64."""
    return torch.stack([c[first : first + frames].double() for c in corpus().clips()[:batch]])


def warm(network, batch=2):
    """A state that has seen some frames."""
    seen = clip(batch, 12, first=8)
    return network.advance(network.start_after(seen[:, 0]), seen[:, 1:])


def rolled(network, state, frames=8, seed=0):
    """Noise, its likeliest plan, and the rollout under it."""
    draws = noise(state.batch, frames, seed=seed, dtype=torch.float64)
    plan = network.plan(state, draws)
    return draws, plan, *network.rollout(state, draws, plan)


def mixture_of(network, state, frames):
    """The mixtures that the network predicts along given frames."""
    before = torch.cat([state.last_frame[:, None], frames[:, :-1]], 1)
    return network(network.normalise(before), (state.hidden, state.cell))[0]


@each_network
def test_the_density_is_a_mixture_of_normals_times_two_bernoullis(kind):
    network, frames = NETWORKS[kind], clip()
    state = warm(network)
    mixture = mixture_of(network, state, frames)
    mixing = torch.eye(SIZE).double().expand(network.config.components, -1, -1)
    if network.whitening is not None:
        mixing = torch.linalg.inv(network.whitening)
        torch.testing.assert_close(network.mixing, mixing)
    normals = MultivariateNormal(mixture.mean, scale_tril=mixing * mixture.log_sigma.exp().unsqueeze(-2))
    poses = MixtureSameFamily(Categorical(logits=mixture.log_weight), normals)
    bits = Independent(Bernoulli(logits=mixture.contact_logit), 1)
    expected = poses.log_prob(network.normalise(frames)[..., :SIZE]) + bits.log_prob(frames[..., SIZE:])
    torch.testing.assert_close(network.log_prob(frames, state), expected)
    torch.testing.assert_close(mixture.log_weight.exp().sum(-1), torch.ones(2, 9).double())
    assert float(mixture.log_sigma.min()) > network.config.min_log_sigma
    assert float(mixture.log_sigma.max()) < network.config.max_log_sigma


@each_network
def test_a_rollout_scores_its_component_which_is_part_of_the_mixture(kind):
    network = NETWORKS[kind]
    state = warm(network)
    _, plan, frames, density = rolled(network, state)
    whole = network.log_prob(frames, state)
    if network.config.components == 1:
        torch.testing.assert_close(density, whole)
    else:
        assert bool((density < whole + 1e-9).all())
    mixture = mixture_of(network, state, frames)
    chosen = mixture.log_weight.argmax(-1)
    assert torch.equal(plan.component, chosen)
    assert torch.equal(plan.contacts, mixture.contact_logit > 0)
    # Of one noise, the components' densities differ by their weights and sigmas alone.
    draws = noise(2, 8, dtype=torch.float64)
    plans = [
        DiscreteChoices(torch.full_like(plan.component, k), plan.contacts) for k in range(network.config.components)
    ]
    parts = [network.rollout(state, draws, each) for each in plans]
    first = torch.stack([density[:, 0] for _, density in parts])
    expected = mixture.log_weight[:, 0].T
    torch.testing.assert_close(first.logsumexp(0) - first, expected.logsumexp(0) - expected + spread(mixture)[:, 0].T)


def spread(mixture):
    """How the components' sigmas differ in the densities of one and the same noise, nats."""
    sums = mixture.log_sigma.sum(-1)
    own = mixture.log_weight - sums
    return own.logsumexp(-1, keepdim=True) - own - (mixture.log_weight.logsumexp(-1, keepdim=True) - mixture.log_weight)


@each_network
def test_noise_is_the_standardised_error_of_the_chosen_component(kind):
    network = NETWORKS[kind]
    state = warm(network)
    draws, plan, frames, _ = rolled(network, state)
    mixture = mixture_of(network, state, frames)
    picked = plan.component[..., None, None].expand(-1, -1, 1, SIZE)
    mean, sigma = (part.gather(-2, picked)[..., 0, :] for part in (mixture.mean, mixture.log_sigma.exp()))
    error = network.normalise(frames)[..., :SIZE] - mean
    if network.whitening is not None:
        error = (network.whitening[plan.component] @ error.unsqueeze(-1))[..., 0]
    torch.testing.assert_close(error / sigma, draws, atol=1e-7, rtol=1e-7)
    assert torch.equal(frames[..., SIZE:] > 0.5, plan.contacts)


@each_network
def test_draws_follow_the_mixture(kind):
    network = NETWORKS[kind]
    count = 4000
    state = warm(network, 1)
    drawn, _ = network.sample(state.expand(count), 1, generator(3))
    mixture = mixture_of(network, state, clip(1, 1))
    weight = mixture.log_weight[0, 0].exp()[:, None]
    mean = (weight * mixture.mean[0, 0]).sum(0)
    variance = (2 * mixture.log_sigma[0, 0]).exp()
    if network.mixing is not None:
        variance = (network.mixing**2 @ variance.unsqueeze(-1))[..., 0]
    second = (weight * (mixture.mean[0, 0] ** 2 + variance)).sum(0)
    error = (second - mean**2).sqrt() / count**0.5
    values = network.normalise(drawn)[:, 0]
    assert float(((values[:, :SIZE].mean(0) - mean) / error).abs().max()) < 4.5
    torch.testing.assert_close((values[:, :SIZE] ** 2).mean(0), second, rtol=0.15, atol=1e-3)
    bits = drawn[:, 0, SIZE:].double().mean(0)
    torch.testing.assert_close(bits, torch.sigmoid(mixture.contact_logit[0, 0]), atol=0.04, rtol=0)


def test_at_temperature_zero_only_the_discrete_choices_are_drawn():
    network = NETWORKS["one"]
    state = warm(network)
    drawn, _ = network.sample(state, 6, generator(1), temperature=0.0)
    plan = DiscreteChoices(torch.zeros(2, 6, dtype=torch.long), drawn[..., SIZE:] > 0.5)
    torch.testing.assert_close(network.rollout(state, torch.zeros(2, 6, SIZE).double(), plan)[0], drawn)


def test_long_free_runs_stay_finite():
    network = NETWORKS["several"]
    drawn, _ = network.sample(warm(network), 300, generator(), temperature=2.0)
    assert bool(torch.isfinite(drawn).all())
