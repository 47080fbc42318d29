"""Variants of the tweener that are trained to compare: the paper's, sparse keys, one stage, repeated frames."""

from dataclasses import replace
from pathlib import Path

import pytest
import tiny_path
import tiny_tweener
import torch
from helpers import corpus, generator

from mapctl.commands.train.tweener import TrainTweener
from mapctl.errors import RequestError
from priors.training.augmentation.key_layouts import KeySettings, draw_windows
from priors.training.augmentation.pose_windows import PoseWindows
from priors.training.recipes.tweener import PAPER, TweenerSettings, TweenerTrainer
from priors.training.recipes.tweener_critic import CriticisedTrainer, CriticisedTweenerRecipe, CriticSettings
from priors.tweening import generator as networks
from priors.tweening.keys import make_key_image

SETTINGS = TweenerSettings(steps=15, batch=200, learning_rate=1e-2, layout=KeySettings(longest=60.0))


@pytest.fixture(scope="module")
def clips():
    return corpus(4, 150)


def recipe(**options):
    return TrainTweener(data=Path("data"), out=Path("run"), **options).recipe()


def image(clips, frames=60):
    windows = PoseWindows(clips, kinds=(), evenness=1.0)
    drawn = draw_windows(windows, 2, frames, SETTINGS.layout, progress=1.0, tempo=0.0, generator=generator())
    return make_key_image(drawn.motion, drawn.told)


def test_paper_has_its_sizes_losses_optimiser_and_critic():
    found = recipe(paper=True, steps=20)
    assert isinstance(found, CriticisedTweenerRecipe)
    assert (found.config, found.critic.begin) == (networks.PAPER, 0)
    assert found.settings == replace(PAPER[1], steps=20)
    assert not isinstance(recipe(paper=True, critic_from="never"), CriticisedTweenerRecipe)
    assert "--paper" in found.format_command()


@pytest.mark.parametrize("given", ["-1", "soon", "30"])
def test_a_critic_joins_at_a_step_of_the_run(given):
    with pytest.raises(RequestError, match="critic-from"):
        recipe(steps=30, critic_from=given)


def test_the_way_s_weight_grows_where_it_is_asked_to(clips):
    settings = replace(SETTINGS, root_growth=100.0, steps=3000)
    one, other = (TweenerTrainer(tiny_tweener.CONFIG, settings, clips, tiny_path.network()) for _ in range(2))
    other.step = 2999
    one.grown = other.grown = True
    assert float(other.losses()["loss"].detach()) > 1.1 * float(one.losses()["loss"].detach())


@pytest.mark.slow
def test_paper_trains_for_some_steps(clips):
    settings = replace(PAPER[1], steps=20, batch=512, splice=(512, 512))
    learner = TweenerTrainer(networks.PAPER, settings, clips, tiny_path.network())
    trainer = CriticisedTrainer(learner, CriticSettings(batch=2, history=4, frames=94))
    rows = [trainer.train_step() for _ in range(20)]
    assert all(torch.isfinite(torch.tensor(list(row.values()))).all() for row in rows)
    assert sum(values.numel() for values in learner.network.parameters()) > 30e6
