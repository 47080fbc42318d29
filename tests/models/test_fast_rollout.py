"""The fast path against its specification, the torch reference, and against finite differences of that."""

import pytest
import torch

from mapctl.protocols import DiscreteChoices
from priors.lstm_gmm.fast import FastRollout
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig, LstmState

CASES = [(7, 1, 5), (64, 3, 5), (64, 8, 1), (33, 5, 4), (256, 1, 5)]  # width, batch, components
FRAMES = 12


def make(width: int, batch: int, components: int = 5, *, frames: int = FRAMES, kind: torch.dtype = torch.float32):
    """A random network, livelier than a fresh one so that components, bits, clamps vary; state and noise."""
    generator = torch.Generator().manual_seed(width + batch)
    size = LstmGmm(LstmGmmConfig(width=1), mean=torch.zeros(68), std=torch.ones(68)).layout.size
    mean, std = 0.1 * torch.randn(size, generator=generator), 0.2 + torch.rand(size, generator=generator)
    torch.manual_seed(width)
    model = LstmGmm(LstmGmmConfig(width=width, components=components), mean=mean, std=std)
    with torch.no_grad():
        for weight in model.out.parameters():
            weight *= 3
        if model.correlation is not None:
            model.correlation.copy_(0.05 * torch.randn(model.correlation.shape, generator=generator))
    hidden, cell = 0.5 * torch.randn(2, 2, batch, width, generator=generator)
    previous = 2 * torch.randn(batch, size, generator=generator)
    noise = torch.randn(batch, frames, size - 2, generator=generator)
    return model.to(kind), LstmState(previous.to(kind), hidden.to(kind), cell.to(kind)), noise.to(kind)


def gradients(engine: LstmGmm | FastRollout, state: LstmState, noise: torch.Tensor, plan: DiscreteChoices):
    """Features, densities and the gradient of a random functional of both on the noise and on the state."""
    generator = torch.Generator().manual_seed(5)
    noise = noise.clone().requires_grad_()
    state = LstmState(*(part.clone().requires_grad_() for part in vars(state).values()))
    features, density = engine.rollout(state, noise, plan)
    pull = [torch.randn(part.shape, generator=generator).to(part) for part in (features, density)]
    inputs = (noise, state.last_frame, state.hidden, state.cell)
    grads = torch.autograd.grad([(features * pull[0]).sum(), (density * pull[1]).sum()], inputs)
    return features.detach(), density.detach(), *grads


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
def test_long_window_of_any_plan_agrees_in_energy_and_gradient():
    model, state, noise = make(40, 2, frames=100)
    generator = torch.Generator().manual_seed(1)
    plan = DiscreteChoices(
        torch.randint(5, (2, 100), generator=generator), torch.rand(2, 100, 2, generator=generator) < 0.5
    )
    assert plan.component.unique().numel() == 5
    for ours, theirs in zip(
        gradients(FastRollout(model), state, noise, plan), gradients(model, state, noise, plan), strict=True
    ):
        assert relative(ours, theirs) < 1e-4


def test_gradient_matches_finite_differences_of_the_reference_in_float64():
    model, state, noise = make(16, 2, frames=6, kind=torch.float64)
    plan = model.plan(state, noise)
    gradient = gradients(FastRollout(model), state, noise, plan)[2]
    assert gradient.dtype == torch.float64
    generator, step = torch.Generator().manual_seed(9), 1e-5
    for _ in range(5):
        direction = torch.randn(noise.shape, generator=generator, dtype=torch.float64)
        plus, minus = (_functional(model, state, noise + sign * step * direction, plan) for sign in (1, -1))
        assert float((gradient * direction).sum()) == pytest.approx((plus - minus) / (2 * step), rel=1e-4)


def _functional(model: LstmGmm, state: LstmState, noise: torch.Tensor, plan: DiscreteChoices) -> float:
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        parts = model.rollout(state, noise, plan)
        return float(sum((part * torch.randn(part.shape, generator=generator).to(part)).sum() for part in parts))


@pytest.mark.parametrize(("width", "batch", "components"), CASES)
def test_plan_and_its_rollout_in_one_pass(width, batch, components):
    model, state, noise = make(width, batch, components)
    fast, wanted = FastRollout(model), model.plan(state, noise)
    plan, features, density = fast.plan_and_rollout(state, noise)
    assert torch.equal(plan.component, wanted.component)
    assert torch.equal(plan.contacts, wanted.contacts)
    assert torch.equal(fast.plan(state, noise).component, plan.component)
    for ours, theirs in zip((features, density), fast.rollout(state, noise, plan), strict=True):
        assert torch.equal(ours, theirs)


def test_torch_terms_chain_onto_a_rollout_of_particles_from_one_state():
    model, state, noise = make(32, 1)
    noise = noise.expand(6, -1, -1).clone().requires_grad_()
    fast = FastRollout(model)
    features, density = fast.rollout(state, noise, fast.plan(state, noise.detach()))
    (gradient,) = torch.autograd.grad(features[..., 0].cumsum(1).square().sum() - density.sum(), noise)
    assert torch.allclose(gradient, gradient[:1].expand_as(gradient), rtol=1e-4, atol=1e-5)
    assert gradient.abs().sum() > 0


def test_particles_do_not_touch_each_other():
    model, state, noise = make(24, 5)
    fast = FastRollout(model)
    plan = fast.plan(state, noise)
    together = gradients(fast, state, noise, plan)[0]
    alone = LstmState(state.last_frame[2:3], state.hidden[:, 2:3], state.cell[:, 2:3])
    single, _ = fast.rollout(alone, noise[2:3], DiscreteChoices(plan.component[2:3], plan.contacts[2:3]))
    assert torch.allclose(single[0], together[2], rtol=1e-5, atol=1e-5)


def test_samples_repeat_with_the_seed_and_carry_the_state_on():
    model, state, _ = make(24, 3)
    fast = FastRollout(model)
    first, after = fast.sample(state, 21, torch.Generator().manual_seed(3))
    again, _ = fast.sample(state, 21, torch.Generator().manual_seed(3))
    other, _ = fast.sample(state, 21, torch.Generator().manual_seed(4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    wanted = model.advance(state, first)
    for name in ("last_frame", "hidden", "cell"):
        assert relative(getattr(after, name), getattr(wanted, name)) < 1e-5


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
