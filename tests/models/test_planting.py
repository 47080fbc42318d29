"""Samples given that planted toes stand: the conditional Gaussian, by another formula, and nothing where no toe is."""

import pytest
import torch
from helpers import generator, tiny_density, walk
from torch import Tensor

from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, encode
from mapctl.pose import BodyPose
from mapctl.skeleton import TOE_JOINTS
from priors.lstm_gmm.network import Planting

SIZE = LAYOUT.continuous
SIGMA = 0.06


def place_toes(frame: Tensor) -> Tensor:
    """After one frame from the origin, by the pose and not by the kernels."""
    pose = BodyPose.of_features(frame[None], GroundPose.origin(frame.dtype))
    return pose.joints_world()[0, list(TOE_JOINTS)].flatten()


@pytest.fixture(scope="module")
def frames():
    """Two frames of a walk, of which both say that both toes stand."""
    features = encode(walk(40))[0].float()[20:22]
    features[:, SIZE:] = 1.0
    return features


@pytest.fixture(scope="module")
def factor():
    """Of a covariance whose values depend on each other."""
    made = 0.01 * torch.randn(SIZE, SIZE, generator=generator(1)) / SIZE**0.5 + 0.004 * torch.eye(SIZE)
    made[:2] *= 0.3
    return made


def condition(before, mean, factor, *, bits=(1.0, 1.0), count=1, seed=0):
    noise = torch.randn(count, SIZE, generator=generator(seed))
    sample = torch.cat([mean + noise @ factor.T, torch.tensor(bits).expand(count, 2)], dim=-1)
    rows = (before.expand(count, -1), sample, mean.expand(count, -1), factor.expand(count, -1, -1))
    return sample, Planting(SIGMA).condition(*rows, generator(seed + 1))


@pytest.mark.slow
def test_samples_are_those_of_the_conditional_gaussian(frames, factor):
    before, mean = frames[0], frames[1, :SIZE]
    still = before.clone()
    still[:3] = 0
    base = torch.cat([mean, frames[1, SIZE:]]).double()
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


@pytest.mark.slow
def test_toes_stand_then_and_only_those_that_are_planted_in_both(frames, factor):
    def slide(sample):
        still = frames[0].clone()
        still[:3] = 0
        steps = torch.stack([place_toes(row) for row in sample]) - place_toes(still)
        return PRIOR_FPS * steps.unflatten(1, (2, 3)).norm(dim=-1).square().mean(0).sqrt()

    sample, both = condition(frames[0], frames[1, :SIZE], factor, count=200)
    _, left = condition(frames[0], frames[1, :SIZE], factor, bits=(1.0, 0.0), count=200)
    raw = slide(sample)
    assert (slide(both) < 0.5 * raw).all()
    assert slide(left)[0] < 0.5 * raw[0]
    assert slide(left)[1] > 0.7 * raw[1]
    swinging = frames[0].clone()
    swinging[SIZE:] = 0.0
    untouched, found = condition(swinging, frames[1, :SIZE], factor, count=5)
    assert torch.equal(untouched, found)


def test_a_density_samples_so(monkeypatch):
    density = tiny_density()
    state = density.initial_states.state.pick(torch.tensor([0]))
    one, same = (density.sample_planted(state, 20, generator(3), sigma_speed=SIGMA)[0] for _ in range(2))
    assert torch.equal(one, same)
    assert one.isfinite().all()
    plain = density.reference.sample(state, 20, generator(3))[0]
    assert not torch.allclose(one, plain)
    # Nothing is random about a toe without noise: the frames are the means.
    cold, mean = (
        density.reference.sample(state, 20, generator(3), temperature=0.0, planting=planting)[0]
        for planting in (Planting(SIGMA), None)
    )
    assert torch.allclose(cold[:, 0], mean[:, 0], atol=1e-6)
