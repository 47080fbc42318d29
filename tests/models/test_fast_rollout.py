"""The fast path against its specification, the torch reference, and against finite differences of that."""

import pytest
import torch

from mapctl.features import LAYOUT
from mapctl.protocols import DiscreteChoices
from priors.lstm_gmm.fast import FastRollout
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig, LstmState

CASES = [(7, 1, 5), (64, 3, 5), (64, 8, 1), (33, 5, 4), (256, 1, 5)]  # width, batch, components
FRAMES = 12


def make(width: int, batch: int, components: int = 5, *, frames: int = FRAMES, kind: torch.dtype = torch.float32):
    """A random network, livelier than a fresh one so that components, bits, clamps vary; state and noise."""
    generator = torch.Generator().manual_seed(width + batch)
    size = LAYOUT.size
    mean, std = 0.1 * torch.randn(size, generator=generator), 0.2 + torch.rand(size, generator=generator)
    torch.manual_seed(width)
    model = LstmGmm(LstmGmmConfig(width=width, components=components), mean=mean, std=std)
    with torch.no_grad():
        for weight in model.out.parameters():
            weight *= 3
        model.correlation.copy_(0.05 * torch.randn(model.correlation.shape, generator=generator))
    hidden, cell = 0.5 * torch.randn(2, 2, batch, width, generator=generator)
    previous = 2 * torch.randn(batch, size, generator=generator)
    noise = torch.randn(batch, frames, size - 2, generator=generator)
    return model.to(kind), LstmState(previous.to(kind), hidden.to(kind), cell.to(kind)), noise.to(kind)


def gradients(engine: LstmGmm | FastRollout, state: LstmState, noise: torch.Tensor, plan: DiscreteChoices):
    """Features, densities and the gradient of a random functional of both on the noise."""
    generator = torch.Generator().manual_seed(5)
    noise = noise.clone().requires_grad_()
    features, density = engine.rollout(state, noise, plan)
    pull = [torch.randn(part.shape, generator=generator).to(part) for part in (features, density)]
    (gradient,) = torch.autograd.grad([(features * pull[0]).sum(), (density * pull[1]).sum()], noise)
    return features.detach(), density.detach(), gradient


def relative(value: torch.Tensor, wanted: torch.Tensor) -> float:
    return float((value - wanted).norm() / wanted.norm())


@pytest.mark.parametrize(("width", "batch", "components"), CASES)
def test_rollout_and_pullback_agree_with_the_reference(width, batch, components):
    model, state, noise = make(width, batch, components)
    plan = model.plan(state, noise)
    fast = gradients(FastRollout(model), state, noise, plan)
    for ours, theirs in zip(fast, gradients(model, state, noise, plan), strict=True):
        assert relative(ours, theirs) < 2e-5


@pytest.mark.slow
def test_samples_are_distributed_as_the_reference():
    model, state, _ = make(12, 1)
    count = 20_000
    many = state.expand(count)
    ours, _ = FastRollout(model).sample(many, 2, torch.Generator().manual_seed(1), temperature=0.7)
    theirs, _ = model.sample(many, 2, torch.Generator().manual_seed(2), temperature=0.7)
    error = (ours.mean(0) - theirs.mean(0)) / (theirs.std(0) * (2 / count) ** 0.5 + 1e-9)
    assert error.abs().max() < 4.5  # standard errors, over 136 values
    assert torch.allclose(ours.std(0), theirs.std(0), rtol=0.05, atol=1e-3)


def test_not_a_number_is_not_hidden():
    model, state, noise = make(16, 1)
    fast = FastRollout(model)
    plan = fast.plan(state, noise)
    noise[0, 4, 7] = float("nan")
    features, density = fast.rollout(state, noise, plan)
    assert torch.isfinite(features[0, :4]).all()
    assert torch.isnan(features[0, 4, 7])
    assert torch.isnan(density[0, 4])
