"""Contract of every density (see mapctl.protocols.Density)."""

import copy
import math
import pickle

import pytest
import torch
from catalogue import DENSITIES
from helpers import corpus, finite_difference, generator, noise

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from mapctl.protocols import Density, DensityState, DiscreteChoices

SIZE = LAYOUT.continuous
each_density = pytest.mark.parametrize("density", DENSITIES.values(), ids=DENSITIES)


def dtype_of(density):
    """That of its states; kernels compute in single precision whatever they are given."""
    return density.initial_states.state.last_frame.dtype


def clip(density, batch=2, frames=9, first=20):
    """Frames of the walks."""
    return torch.stack([c[first : first + frames] for c in corpus().clips()[:batch]]).to(dtype_of(density))


def warm(density, batch=2):
    """A state that has seen some frames."""
    seen = clip(density, batch, 12, first=8)
    return density.advance(density.start_after(seen[:, 0]), seen[:, 1:])


def roll(density, state, frames=8, seed=0):
    """Noise, its likeliest plan, and the rollout under it."""
    draws = noise(state.batch, frames, seed=seed, dtype=dtype_of(density))
    plan = density.plan(state, draws)
    return draws, plan, *density.rollout(state, draws, plan)


def close(density, ours, theirs):
    loose = {} if dtype_of(density) is torch.float64 else {"atol": 2e-3, "rtol": 2e-4}
    torch.testing.assert_close(ours, theirs, **loose)


@each_density
def test_it_has_what_it_must(density):
    assert isinstance(density, Density)
    assert density.limits.slowest < density.limits.fastest
    assert density.feature_std.shape == (LAYOUT.size,)
    starts = density.initial_states
    assert starts.state.batch == len(starts.names) == len(starts.speed) == len(starts.weight)
    assert float(starts.weight.sum()) == pytest.approx(1)
    density.warm_up()


@each_density
def test_it_is_pickled_and_copied_after_use_as_before(density):
    size = len(pickle.dumps(density))
    draws, plan, *expected = roll(density, warm(density))
    assert len(pickle.dumps(density)) == size, "without what is cached"
    for copied in (pickle.loads(pickle.dumps(density)), copy.deepcopy(density)):  # noqa: S301
        for ours, theirs in zip(copied.rollout(warm(copied), draws, plan), expected, strict=True):
            assert torch.equal(ours, theirs)


@each_density
def test_shapes_are_those_of_the_layout(density):
    state = warm(density)
    draws, plan, frames, scores = roll(density, state)
    assert (plan.component.shape, plan.contacts.shape) == ((2, 8), (2, 8, 2))
    assert (frames.shape, scores.shape) == ((2, 8, LAYOUT.size), (2, 8))
    assert torch.equal(frames[..., SIZE:] > 0.5, plan.contacts)
    choices, found = density.latents(frames, state)
    assert (choices.component.shape, choices.contacts.shape, found.shape) == ((2, 8), (2, 8, 2), draws.shape)
    assert density.log_prob(frames, state).shape == (2, 8)
    drawn, after = density.sample(state, 3, generator())
    assert (drawn.shape, after.batch) == ((2, 3, LAYOUT.size), 2)


@each_density
def test_states_are_picked_and_expanded_by_row(density):
    state = warm(density, 3)
    assert isinstance(state, DensityState)
    assert state.batch == 3
    turned = state.pick(torch.tensor([2, 0, 0]))
    frames = clip(density, 3)
    each = density.log_prob(frames, state)
    close(density, density.log_prob(frames[[2, 0, 0]], turned), each[[2, 0, 0]])
    copies = state.pick(torch.tensor([1])).expand(4)
    assert copies.batch == 4
    close(density, density.log_prob(frames[1:2].expand(4, -1, -1), copies), each[1].expand(4, -1))
    assert state.expand(3) is state
    with pytest.raises(ValueError, match="batch 3 cannot serve a batch of 4"):
        state.expand(4)


@each_density
def test_rows_of_a_batch_know_nothing_of_each_other(density):
    state = warm(density, 3)
    draws, plan, frames, scores = roll(density, state)
    together = density.log_prob(frames, state)
    for row in range(3):
        alone, own = state.pick(torch.tensor([row])), slice(row, row + 1)
        close(density, density.log_prob(frames[own], alone)[0], together[row])
        choices = DiscreteChoices(plan.component[own], plan.contacts[own])
        close(density, [part[0] for part in density.rollout(alone, draws[own], choices)], [frames[row], scores[row]])


@each_density
def test_a_state_advanced_by_frames_continues_their_rollout(density):
    state = warm(density)
    draws, plan, frames, scores = roll(density, state)
    later = density.advance(state, frames[:, :5])
    assert torch.equal(later.last_frame, frames[:, 4])
    close(density, density.log_prob(frames[:, 5:], later), density.log_prob(frames, state)[:, 5:])
    choices = DiscreteChoices(plan.component[:, 5:], plan.contacts[:, 5:])
    close(density, density.rollout(later, draws[:, 5:], choices), (frames[:, 5:], scores[:, 5:]))
    again = density.plan(later, draws[:, 5:])
    assert torch.equal(again.component, choices.component)
    assert torch.equal(again.contacts, choices.contacts)
    by_one = density.advance(density.advance(state, frames[:, :2]), frames[:, 2:5])
    close(density, density.log_prob(frames[:, 5:], by_one), density.log_prob(frames[:, 5:], later))


@each_density
def test_the_rollout_of_its_latents_is_the_motion(density):
    state, frames = warm(density), clip(density)
    close(density, density.rollout(state, *reversed(density.latents(frames, state)))[0], frames)


@pytest.mark.slow
@each_density
def test_gradients_are_those_of_finite_differences(density):
    state, exact = warm(density), dtype_of(density) is torch.float64
    draws, plan, frames, _ = roll(density, state, frames=5)
    weight = torch.randn(frames.shape, generator=generator(5)).to(frames)

    def of_rollout(values):
        features, scores = density.rollout(state, values, plan)
        return (features * weight).sum() + scores.sum()

    def of_density(values):
        return density.log_prob(torch.cat([values, frames[..., SIZE:]], dim=-1), state).sum()

    for measure, at in ((of_rollout, draws), (of_density, frames[..., :SIZE])):
        leaf = at.clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(measure(leaf), leaf)
        direction = gradient / gradient.norm()  # the steepest, which single precision still sees
        expected = finite_difference(measure, at, direction, step=1e-6 if exact else 1e-2 / float(gradient.norm()))
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5 if exact else 0.05)


@each_density
def test_samples_obey_the_seed_and_leave_the_state_after_them(density):
    state = warm(density)
    drawn, after = density.sample(state, 6, generator(1))
    assert torch.equal(density.sample(state, 6, generator(1))[0], drawn)
    assert not torch.equal(density.sample(state, 6, generator(2))[0], drawn)
    frames = clip(density)
    close(density, density.log_prob(frames, after), density.log_prob(frames, density.advance(state, drawn)))


@each_density
def test_the_state_before_a_motion_is_found(density):
    frames = clip(density, 1)
    state = density.infer_state(frames[0])
    assert state.batch == 1
    assert bool(torch.isfinite(density.log_prob(frames, state)).all())


@each_density
def test_what_has_no_labels_takes_none(density):
    assert not density.labels
    with pytest.raises(RequestError, match="has no"):
        density.conditioned_on(["run"])
    frames = clip(density)
    for other in (density.conditioned_on([]), density.conditioned_like_start(0)):
        close(density, other.log_prob(frames, warm(other)), density.log_prob(frames, warm(density)))


@each_density
def test_observation_noise_gives_a_density_again(density):
    other = density.with_observation_noise(torch.full((SIZE,), 0.01))
    assert isinstance(other, Density)
    assert other.reference_log_density == density.reference_log_density == -math.inf
    frames = clip(density)
    assert bool(torch.isfinite(other.log_prob(frames, warm(other))).all())
