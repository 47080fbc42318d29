"""The critic of the tweener: what it sees and is told, and the guard of its training."""

import math
from dataclasses import replace

import pytest
import tiny_path
import tiny_tweener
import torch
from helpers import corpus, generator

from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from priors.training.adversaries import body_motion
from priors.training.adversaries.body_motion import FIELD, BodyMotionCritic
from priors.training.adversaries.guard import find_winner
from priors.training.augmentation.key_layouts import KeySettings
from priors.training.recipes.tweener import TweenerSettings, TweenerTrainer
from priors.training.recipes.tweener_critic import CriticisedTrainer, CriticSettings

SETTINGS = TweenerSettings(steps=6, batch=300, layout=KeySettings(longest=60.0))
CRITIC = CriticSettings(begin=2, batch=4, history=8, frames=100)


@pytest.fixture(scope="module")
def clips():
    return corpus(4, 160)


def trainer(clips, critic=CRITIC, settings=SETTINGS):
    learner = TweenerTrainer(tiny_tweener.CONFIG, settings, clips, tiny_path.network())
    return CriticisedTrainer(learner, critic)


def moving(frames=130, batch=2):
    places = torch.randn(batch, 1, 21, 3, generator=generator()) * 0.3
    places = places + 0.02 * torch.randn(batch, frames, 21, 3, generator=generator(1))
    return LocalMotion.of_world(places, torch.zeros(batch, frames))


def still_way(motion):
    zero = torch.zeros_like(motion.turns)
    return RootTrajectory(torch.zeros(*zero.shape, 2), zero, torch.zeros(*zero.shape, 2))


def test_a_score_is_of_so_many_frames():
    critic = BodyMotionCritic()
    rows = body_motion.show(moving(400, 1), still_way(moving(400, 1))).requires_grad_()
    scores, _ = critic(rows)
    (slope,) = torch.autograd.grad(scores[0, 5], rows)
    seen = slope[0].abs().sum(dim=-1).nonzero()[:, 0]
    assert int(seen[-1] - seen[0]) + 1 == FIELD


def test_toes_that_slide_a_little_are_magnified():
    motion = moving()
    slow = still_way(motion)
    sliding = RootTrajectory(slow.steps_heading + 0.002, slow.height, slow.contacts)
    apart = (body_motion.show(motion, slow) - body_motion.show(motion, sliding)).abs()
    assert float(apart[..., :-4].max()) == 0
    still = LocalMotion.of_world(motion.places[:, :1].expand_as(motion.places), torch.zeros_like(motion.turns))
    apart = (body_motion.show(still, slow) - body_motion.show(still, sliding)).abs()
    assert float(apart[..., -4:].min()) == pytest.approx(0.5 * math.asinh(0.002 * 30 / 0.05), rel=1e-4)


def test_losses_are_the_papers():
    real, made = torch.tensor([[1.0, 0.5]]), torch.tensor([[-1.0], [0.0]])
    assert float(body_motion.compute_critic_loss(real, made)) == pytest.approx(0.125 + 0.5)
    assert float(body_motion.compute_generator_loss(torch.full((2, 3), 0.2361))) == pytest.approx(0.0, abs=1e-6)


def test_the_penalty_is_the_squared_slope():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        critic = BodyMotionCritic().double()
    rows = body_motion.show(moving(), still_way(moving())).double()
    found = float(body_motion.compute_gradient_penalty(critic, rows).detach())
    towards = torch.randn(rows.shape, generator=generator(3), dtype=torch.float64)
    rows = rows.requires_grad_()
    (slope,) = torch.autograd.grad(critic(rows)[0].sum(), rows)
    step = 1e-7 * towards  # few of its kinks are so near
    with torch.no_grad():
        change = float(critic(rows + step)[0].sum() - critic(rows - step)[0].sum()) / 2
    assert change == pytest.approx(float((slope * step).sum()), rel=1e-3)
    assert found == pytest.approx(float(slope.square().sum()) / len(rows), rel=1e-6)


@pytest.mark.slow
def test_a_critic_learns_to_tell_made_from_captured_and_moves_the_generator(clips):
    critic = CriticSettings(begin=0, batch=8, history=16, frames=100, rate=1e-3)
    made = trainer(clips, critic, replace(SETTINGS, steps=20))
    before = [each.clone() for each in made.learner.network.parameters()]
    losses = [made.train_step()["critic"] for _ in range(16)]
    assert sum(losses[-4:]) < 0.9 * sum(losses[:4])
    after = made.learner.network.parameters()
    assert any(not torch.equal(one, other) for one, other in zip(before, after, strict=True))
    row = made.validate(clips)
    assert row["critic_training"] > row["critic_made"]
    assert 0 < row["moved_cm"] < 20


@pytest.mark.slow
def test_before_it_joins_training_is_by_distances_alone(clips):
    made, plain = trainer(clips), TweenerTrainer(tiny_tweener.CONFIG, SETTINGS, clips, tiny_path.network())
    for _ in range(2):
        made.train_step()
        plain.train_step()
    for name, values in plain.network.state_dict().items():
        assert torch.equal(values, made.network.state_dict()[name])
    assert "critic_made" not in made.validate(clips)


@pytest.mark.slow
def test_stopped_and_resumed_it_is_the_same(clips):
    whole, first = trainer(clips), trainer(clips)
    for _ in range(5):
        whole.train_step()
    for _ in range(4):
        first.train_step()
    second = trainer(clips)
    second.load_state({name: values.clone() for name, values in first.state().items()}, 4)
    second.train_step()
    for name, values in whole.state().items():
        assert torch.equal(values, second.state()[name]), name


@pytest.mark.slow
def test_measuring_changes_nothing(clips):
    made = trainer(clips)
    for _ in range(3):
        made.train_step()
    before = {name: values.clone() for name, values in made.state().items()}
    made.validate(clips)
    assert all(torch.equal(values, made.state()[name]) for name, values in before.items())


def test_a_guard_ends_what_is_lost():
    fair = [{"generator": 1.0, "critic": 1.5, "told": 0.7}] * 5
    assert find_winner(fair, losses=("generator", "critic"), least=5, step="step 5") is None
    won = [{**row, "told": 0.99} for row in fair]
    assert find_winner(won, losses=("generator", "critic"), least=5, step="step 5") == "the critic has won"
    assert find_winner(won, losses=("generator", "critic"), least=6, step="step 5") is None
    broken = [*fair, {"generator": math.nan, "critic": 1.0, "told": 0.5}]
    assert find_winner(broken, losses=("generator", "critic"), least=5, step="step 6") == "training diverged at step 6"
