"""The LSTM-GMM against torch.distributions; states before a motion, planted toes and labels."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from catalogue import NETWORKS
from helpers import corpus, generator, noise, tiny_density, walk
from torch import Tensor
from torch.distributions import Bernoulli, Categorical, Independent, MixtureSameFamily, MultivariateNormal
from trainable_models import small_settings

from mapctl.errors import RequestError
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode
from mapctl.pose import BodyPose
from mapctl.protocols import DataLimits, DiscreteChoices
from mapctl.skeleton import TOE_JOINTS
from priors.checkpoints import Card
from priors.lstm_gmm import density
from priors.lstm_gmm.density import LstmGmmDensity
from priors.lstm_gmm.network import (
    MAX_LOG_SIGMA,
    MIN_LOG_SIGMA,
    LstmGmm,
    LstmGmmConfig,
    LstmState,
    condition_on_standing,
)
from priors.training.data import compute_feature_statistics
from priors.training.recipes.lstm_gmm import DensityTrainer, select_initial_states

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
    cholesky = torch.linalg.inv(network.inverse_cholesky)
    torch.testing.assert_close(network.cholesky, cholesky)
    normals = MultivariateNormal(mixture.mean, scale_tril=cholesky * mixture.log_sigma.exp().unsqueeze(-2))
    poses = MixtureSameFamily(Categorical(logits=mixture.log_weight), normals)
    bits = Independent(Bernoulli(logits=mixture.contact_logit), 1)
    expected = poses.log_prob(network.normalise(frames)[..., :SIZE]) + bits.log_prob(frames[..., SIZE:])
    torch.testing.assert_close(network.log_prob(frames, state), expected)
    torch.testing.assert_close(mixture.log_weight.exp().sum(-1), torch.ones(2, 9).double())
    assert float(mixture.log_sigma.min()) > MIN_LOG_SIGMA
    assert float(mixture.log_sigma.max()) < MAX_LOG_SIGMA


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
def test_draws_follow_the_mixture(kind):
    network = NETWORKS[kind]
    count = 4000
    state = warm(network, 1)
    drawn, _ = network.sample(state.expand(count), 1, generator(3))
    mixture = mixture_of(network, state, clip(1, 1))
    weight = mixture.log_weight[0, 0].exp()[:, None]
    mean = (weight * mixture.mean[0, 0]).sum(0)
    variance = (2 * mixture.log_sigma[0, 0]).exp()
    variance = (network.cholesky**2 @ variance.unsqueeze(-1))[..., 0]
    second = (weight * (mixture.mean[0, 0] ** 2 + variance)).sum(0)
    error = (second - mean**2).sqrt() / count**0.5
    values = network.normalise(drawn)[:, 0]
    assert float(((values[:, :SIZE].mean(0) - mean) / error).abs().max()) < 4.5
    torch.testing.assert_close((values[:, :SIZE] ** 2).mean(0), second, rtol=0.15, atol=1e-3)
    bits = drawn[:, 0, SIZE:].double().mean(0)
    torch.testing.assert_close(bits, torch.sigmoid(mixture.contact_logit[0, 0]), atol=0.04, rtol=0)


def test_long_free_runs_stay_finite():
    network = NETWORKS["several"]
    drawn, _ = network.sample(warm(network), 300, generator(), temperature=2.0)
    assert bool(torch.isfinite(drawn).all())


@cache
def tiny():
    """A density of weights so large that its memory matters."""
    density = tiny_density(width=12)
    for layer in (density.reference.fc3, density.reference.out):
        layer.weight.mul_(4)
    return density


def frames(count=30, seed=3):
    return encode(walk(count, turn_rate=0.4, seed=seed))[0].float()


def nats(state, features):
    with torch.no_grad():
        return float(tiny().log_prob(features[None], state).sum())


def prior(state):
    """Distance of the memory, by the mean and spread of the known ones."""
    known = tiny().initial_states.state
    total = 0.0
    for mine, theirs in ((state.hidden, known.hidden), (state.cell, known.cell)):
        spread = theirs.std(dim=1, correction=0).clamp_min(0.05)
        total += float(0.5 * ((mine[:, 0] - theirs.mean(dim=1)) / spread).square().sum())
    return total


def test_the_first_frames_are_likelier_than_after_an_empty_memory_or_any_known_one():
    first = frames()[:10]
    found = tiny().infer_state(frames())
    assert nats(found, first) > nats(tiny().start_after(first[:1]), first) + 10
    known = tiny().initial_states.state
    for row in range(known.batch):
        other = known.pick(torch.tensor([row]))
        other = LstmState(first[:1], other.hidden, other.cell)
        assert nats(found, first) - prior(found) > nats(other, first) - prior(other)


SIGMA = 0.06


def place_toes(frame: Tensor) -> Tensor:
    """After one frame from the origin, by the pose and not by the kernels."""
    pose = BodyPose.of_features(frame[None], GroundPose.origin(frame.dtype))
    return pose.joints_world()[0, list(TOE_JOINTS)].flatten()


@pytest.fixture(scope="module")
def frames_of_planting():
    """Two frames_of_planting of a walk, of which both say that both toes stand."""
    features = encode(walk(40))[0].float()[20:22]
    features[:, SIZE:] = 1.0
    return features


@pytest.fixture(scope="module")
def factor():
    """A network of correlated components."""
    result = 0.01 * torch.randn(SIZE, SIZE, generator=generator(1)) / SIZE**0.5 + 0.004 * torch.eye(SIZE)
    result[:2] *= 0.3
    return result


def condition(before, mean, factor, *, bits=(1.0, 1.0), count=1, seed=0):
    noise = torch.randn(count, SIZE, generator=generator(seed))
    sample = torch.cat([mean + noise @ factor.T, torch.tensor(bits).expand(count, 2)], dim=-1)
    rows = (before.expand(count, -1), sample, mean.expand(count, -1), factor.expand(count, -1, -1))
    return sample, condition_on_standing(SIGMA, *rows, generator(seed + 1))


@pytest.mark.slow
def test_samples_are_those_of_the_conditional_gaussian(frames_of_planting, factor):
    before, mean = frames_of_planting[0], frames_of_planting[1, :SIZE]
    still = before.clone()
    still[:3] = 0
    base = torch.cat([mean, frames_of_planting[1, SIZE:]]).double()
    jacobian = torch.func.jacrev(place_toes)(base)[:, :SIZE]
    step = place_toes(base) - place_toes(still.double())
    # In the form of information, where the conditioning has that of a gain.
    precision = torch.linalg.inv((factor @ factor.T).double()) + jacobian.T @ jacobian / (SIGMA / PRIOR_FPS) ** 2
    covariance = torch.linalg.inv(precision)
    expected = mean.double() - covariance @ jacobian.T @ step / (SIGMA / PRIOR_FPS) ** 2
    _, found = condition(before, mean, factor, count=20_000)
    values, sigma = found[:, :SIZE].double(), covariance.diagonal().sqrt()
    assert ((values.mean(0) - expected) / sigma).abs().max() < 0.05
    assert (torch.cov(values.T) - covariance).div(sigma[:, None] * sigma).abs().max() < 0.05


def test_a_density_samples_so(monkeypatch):
    density = tiny_density()
    state = density.initial_states.state.pick(torch.tensor([0]))
    one, same = (density.sample_planted(state, 20, generator(3), sigma_speed=SIGMA)[0] for _ in range(2))
    assert torch.equal(one, same)
    assert one.isfinite().all()
    plain = density.reference.sample(state, 20, generator(3))[0]
    assert not torch.allclose(one, plain)
    # Nothing is random about a toe without noise: the frames_of_planting are the means.
    cold, mean = (
        density.reference.sample(state, 20, generator(3), temperature=0.0, sigma_speed=sigma)[0]
        for sigma in (SIGMA, None)
    )
    assert torch.allclose(cold[:, 0], mean[:, 0], atol=1e-6)


CLIPS = ("set_walk_glad_1.bvh", "set_turn-left_glad_2.bvh", "set_turn-right_old_3.bvh", "set_run_old_4.bvh", "odd.bvh")


PATTERN = r"_(?P<gait>walk|run|turn-left|turn-right)_(?P<style>[a-z]+)_"


def test_labels_are_the_named_groups_of_the_clip_names():
    found = density.read_labels(CLIPS, PATTERN)
    assert found.names == ("gait=run", "gait=turn-left", "gait=turn-right", "gait=walk", "style=glad", "style=old")
    held = [{found.names[i] for i in row.nonzero()[:, 0].tolist()} for row in found.held]
    assert held == [
        {"gait=walk", "style=glad"},
        {"gait=turn-left", "style=glad"},
        {"gait=turn-right", "style=old"},
        {"gait=run", "style=old"},
        set(),
    ]
    assert found.groups.tolist() == [[1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1]]


def test_a_mirrored_turn_is_the_other_turn():
    found = density.read_labels(CLIPS, PATTERN)
    assert [found.names[i] for i in found.mirrored] == [
        "gait=run",
        "gait=turn-right",
        "gait=turn-left",
        "gait=walk",
        "style=glad",
        "style=old",
    ]
    only_left = density.read_labels(CLIPS[:2], PATTERN)
    assert only_left.mirrored == list(range(len(only_left.names)))


def told_network() -> LstmGmm:
    mean, std = compute_feature_statistics(corpus().features)
    torch.manual_seed(0)
    return LstmGmm(LstmGmmConfig(width=8, components=2, labels=("gait=run", "style=old")), mean=mean, std=std)


def test_a_conditioned_copy_is_the_network_under_that_condition():
    network, inputs = told_network(), torch.randn(1, 6, 68, generator=generator())
    memory = network.start_after(inputs[:, 0])
    condition = torch.tensor([[0.0, 0.0, 1.0]])  # clean; not running; old
    expected, _ = network(inputs, (memory.hidden, memory.cell), condition=condition)
    unlabelled, _ = network(inputs, (memory.hidden, memory.cell))
    old, _ = network.conditioned_on(["style=old"])(inputs, (memory.hidden, memory.cell))
    torch.testing.assert_close(old.mean, expected.mean)
    assert not torch.allclose(unlabelled.mean, expected.mean)
    with pytest.raises(RequestError, match="no label 'style=new', only gait=run, style=old"):
        network.conditioned_on(["style=new"])


def test_half_of_the_windows_are_shown_no_label(tmp_path):
    data = corpus(5)
    known = density.Labels(("gait=walk", "style=old"), torch.tensor([[1.0, 1.0]] * 5))
    settings = small_settings("lstm-gmm", tmp_path, tmp_path, batch=2000, window=6)
    trainer = DensityTrainer(settings, data, LstmGmmConfig(width=8, components=1, labels=known.names), known)
    _, given = trainer.draw_windows()
    silent = float((given.sum(-1) == 0).double().mean())
    assert pytest.approx(silent, abs=0.04) == 0.5 + 0.5 * 0.09
    assert {tuple(row) for row in given.tolist()} == {(0, 0), (1, 0), (0, 1), (1, 1)}


def labelled_density() -> LstmGmmDensity:
    model, data = told_network(), corpus(4)
    names = ("a_run_old_1", "a_walk_old_2", "a_walk_new_3", "a_run_new_4")
    found = select_initial_states(model, replace(data, names=names), count=4, generator=generator())
    pattern = r"_(?P<gait>run)?(walk)?_(?P<style>old)?"
    card = Card("lstm-gmm", model.config.as_card(), licence="none", data={"labels": pattern})
    return LstmGmmDensity("named", model, found, DataLimits(0.5, 1.5, 1.0), card, use_fast=False)


def test_a_conditioned_density_begins_where_the_labels_hold():
    density = labelled_density()
    old_runner = density.conditioned_on(["run", "style=old"])
    assert old_runner.initial_states.names == ("a_run_old_1",)
    assert len(density.conditioned_on(["old"]).initial_states.names) == 2
    assert float(old_runner.initial_states.weight.sum()) == 1
    assert len(density.conditioned_on([]).initial_states.names) == 4
    state, noise = density.initial_states.state.pick(torch.tensor([0])), torch.zeros(1, 3, 66)
    plan = density.plan(state, noise)
    given, unlabelled = (some.rollout(state, noise, plan)[0] for some in (old_runner, density))
    assert not torch.allclose(given, unlabelled)


def test_a_density_is_conditioned_on_the_labels_of_a_clips_trajectory():
    density = labelled_density()
    state, noise = density.initial_states.state.pick(torch.tensor([0])), torch.zeros(1, 3, 66)
    plan = density.plan(state, noise)

    given = {"a_run_old_1": ["run", "old"], "a_walk_old_2": ["old"], "a_walk_new_3": [], "a_run_new_4": ["run"]}
    for start, name in enumerate(density.initial_states.names):
        like, on = density.conditioned_like_start(start), density.conditioned_on(given[name])
        assert torch.allclose(like.rollout(state, noise, plan)[0], on.rollout(state, noise, plan)[0])
        assert like.initial_states.names == density.initial_states.names
