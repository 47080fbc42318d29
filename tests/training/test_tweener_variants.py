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
from priors.tweening.generator import GeneratorNetwork
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


@pytest.mark.slow
@pytest.mark.parametrize("changed", [{"keys": "sparse"}, {"architecture": "upsampling"}, {"architecture": "one-stage"}])
def test_each_variant_learns(clips, changed):
    config = replace(tiny_tweener.CONFIG, **changed)
    trainer = TweenerTrainer(config, SETTINGS, clips, tiny_path.network())
    losses = [trainer.train_step()["loss"] for _ in range(SETTINGS.steps)]
    assert sum(losses[-3:]) < 0.7 * sum(losses[:3])


def test_sparse_keys_tell_nothing_in_other_frames(clips):
    given = image(clips)
    dense, sparse = (
        GeneratorNetwork(replace(tiny_tweener.CONFIG, keys=keys)).encode_rows(given) for keys in ("dense", "sparse")
    )
    free = ~given.known_axes.flatten(2).any(dim=-1)
    places = slice(0, 63)
    assert float(sparse[free][:, places].abs().max()) == 0
    assert float(dense[free][:, places].abs().max()) > 0
    assert torch.equal(sparse[~free][:, places], dense[~free][:, places] * given.known_axes[~free].flatten(1))


def test_one_stage_makes_the_hips_way_and_two_stages_do_not(clips):
    given, style = image(clips), torch.zeros(2, tiny_tweener.CONFIG.style)
    one = GeneratorNetwork(replace(tiny_tweener.CONFIG, architecture="one-stage"))(given, style)
    assert one.root is not None
    assert one.root.shape == (2, 60, 3)
    assert GeneratorNetwork(tiny_tweener.CONFIG)(given, style).root is None


def test_repeated_frames_have_no_mosaic():
    torch.manual_seed(0)
    rows = torch.ones(1, networks.INPUT_ROWS, 512)
    style = torch.zeros(1, tiny_tweener.CONFIG.style)
    found = {}
    for architecture in ("two-stage", "upsampling"):
        network = GeneratorNetwork(replace(tiny_tweener.CONFIG, architecture=architecture, skips=False))
        made = network.generate(rows, style)[0][..., 192:320]
        found[architecture] = float(torch.diff(made.detach()).abs().mean())
    assert found["upsampling"] < 0.01 * found["two-stage"]


def test_options_make_the_variants():
    assert recipe(keys="sparse").config.keys == "sparse"
    assert recipe(architecture="one-stage").config.architecture == "one-stage"
    assert not recipe(plain=True).config.skips
    assert (
        "--keys sparse --architecture upsampling" in recipe(keys="sparse", architecture="upsampling").format_command()
    )


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
