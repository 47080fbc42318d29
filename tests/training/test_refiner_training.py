"""Adversarial training of the refiner: losses against their formulas, the history, the balance, and learning."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import corpus, generator, walks
from torch.nn.functional import logsigmoid

from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.pose import decode
from priors.refiner import RefinerConfig
from priors.training.data import Corpus
from priors.training.loop import HistoryBuffer
from priors.training.recipes.refiner import AdversarialSettings, AdversarialTrainer, compute_root_error

TINY = RefinerConfig(width=8, memory=6, lookahead=1, joints=("hips", "leftHand", "rightToes"))
SHORT = {"steps": 5, "window": 12, "batch": 4, "warm_up": 2, "head_start": 0, "critic_updates": 1, "history": 10}
SMALL = {"critic_width": 8, "critic_around": 1, "moments": 0.0, "refiner_rate": 1e-3, "critic_rate": 1e-3}
SETTINGS = replace(AdversarialSettings(), **SHORT, **SMALL)
SIZE = LAYOUT.continuous

captured = cache(corpus)


@cache
def trembling() -> Corpus:
    """Other walks, every joint shaken from frame to frame: obviously not captured."""
    clips = [encode(motion)[0].float() for motion in walks(3, 60)]
    joints = LAYOUT.slices["joint_rotations"]
    for number, clip in enumerate(clips):
        clip[:, joints] += 0.1 * torch.randn(clip[:, joints].shape, generator=generator(number))
    return Corpus(("a", "b", "c"), (60,) * 3, torch.cat(clips))


def trainer_of(config=TINY, **changes):
    return AdversarialTrainer(config, replace(SETTINGS, **changes), captured(), trembling())


def trained(trainer, rounds=2):
    """Past the first steps, so that no weight is zero any more."""
    for _ in range(rounds):
        trainer.train_step()
    return trainer


def drawn_next(trainer, draw):
    """What the trainer would draw, its generator left where it was."""
    state = trainer.generator.get_state()
    try:
        return draw()
    finally:
        trainer.generator.set_state(state)


def gradient(model):
    return torch.cat([weight.grad.flatten() for weight in model.parameters()])


def slopes(loss, model):
    """By autograd, clipped to the norm that training allows."""
    flat = torch.cat([slope.flatten() for slope in torch.autograd.grad(loss, list(model.parameters()))])
    return flat * min(1.0, 5.0 / float(flat.norm()))


@pytest.mark.parametrize("root", [0.0, 20.0])
def test_the_refiner_follows_equations_9_and_13(root):
    """-ln D of what it made, and the squared distance of the decoded hips' ways."""
    trainer = trained(trainer_of(root=root))
    raw = drawn_next(trainer, lambda: trainer._draw(trainer.raw))
    made, _ = trainer.refiner(raw)
    adversarial = -logsigmoid(trainer.critic(made)).mean()
    trainer.refiner.zero_grad()
    ways = [torch.stack([way_of(clip) for clip in batch]) for batch in (raw[:, 2:-1], made)]
    total = adversarial + root * (ways[0] - ways[1]).square().sum(-1).mean()
    expected = slopes(total, trainer.refiner)
    assert trainer._refine() == pytest.approx(adversarial.item(), rel=1e-5)
    torch.testing.assert_close(gradient(trainer.refiner), expected, atol=1e-5 * float(expected.abs().max()), rtol=1e-3)


def way_of(features):
    """Hips in the world, (frames, 3), written out: a step of (x, z) is taken in the heading before it."""
    turns = features[:, 2]
    heading = torch.cumsum(turns, 0) - turns
    x, z = features[:, 0], features[:, 1]
    steps = torch.stack([x * heading.cos() + z * heading.sin(), z * heading.cos() - x * heading.sin()], -1)
    ground = torch.cumsum(steps, 0)
    return torch.stack([ground[:, 0], features[:, 3], ground[:, 1]], -1)


def test_the_roots_distance_is_that_of_the_decoded_motions():
    before, after = captured().clips()[0][None, :30], captured().clips()[2][None, :25]
    hips = [decode(clip[0], GroundPose.origin()).root_position[:25] for clip in (before, after)]
    expected = float((hips[0] - hips[1]).square().sum(-1).mean())
    assert expected > 0.01
    assert float(compute_root_error(before, after)) == pytest.approx(expected, rel=1e-4)


def test_the_critic_follows_equation_10_on_as_many_captured_as_made():
    trainer = trained(trainer_of())
    history = HistoryBuffer(trainer.history.windows)

    def batch():
        with torch.no_grad():
            fresh = trainer.refiner(trainer._draw(trainer.raw))[0]
        made = history.mix(fresh, trainer.generator)
        return trainer._draw(trainer.captured), made

    real, made = drawn_next(trainer, batch)
    odds = trainer.critic(real), trainer.critic(made)
    both = -(logsigmoid(odds[0]).mean() + (1 - torch.sigmoid(odds[1])).log().mean())
    told = [*(odds[0].mean(1) > 0).tolist(), *(odds[1].mean(1) < 0).tolist()]
    expected = slopes(both / 2, trainer.critic)
    loss, share = trainer._criticise()
    assert loss == pytest.approx(both.item() / 2, rel=1e-5)
    assert share == pytest.approx(sum(told) / len(told))
    torch.testing.assert_close(gradient(trainer.critic), expected, atol=1e-5 * float(expected.abs().max()), rtol=1e-3)


@pytest.mark.parametrize(
    ("loss", "updates"), [(0.0099, [2, 4, 5, 5]), (0.0101, [2, 2, 2, 2]), (0.99, [2, 2, 2, 2]), (1.01, [2, 1, 1, 1])]
)
def test_the_balance_doubles_and_halves_at_the_stated_losses(monkeypatch, loss, updates):
    trainer = trainer_of(warm_up=0, refiner_updates=2, most_updates=5)
    counts = {"refine": 0}

    def refine():
        counts["refine"] += 1
        return 0.5

    monkeypatch.setattr(trainer, "_refine", refine)
    monkeypatch.setattr(trainer, "_criticise", lambda: (loss, 0.75))
    found = [trainer.train_step() for _ in updates]
    assert [row["updates"] for row in found] == updates
    assert counts["refine"] == sum(updates)
    assert found[0] == {"refiner": 0.5, "critic": loss, "told": 0.75, "updates": 2}


def test_the_critic_sees_bits_and_end_effectors_but_not_where_a_window_stands():
    critic = trainer_of().critic.double()
    windows = captured().features[:24].double().unflatten(0, (2, 12))
    odds = critic(windows)
    assert odds.shape == (2, 12 - 1 - 2)  # a velocity, and a frame on either side
    moved = windows.clone()
    moved[:, 0, :3] += 0.5  # the way to the first frame
    torch.testing.assert_close(critic(moved), odds, atol=1e-9, rtol=0)
    for block in ("contacts", "joint_rotations"):
        other = windows.clone()
        other[:, 5, LAYOUT.slices[block]] += 0.3
        assert float((critic(other) - odds).detach().abs().min()) > 0  # in both directions of time
