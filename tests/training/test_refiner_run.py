"""`mapctl train refiner` on five synthetic clips and a density of a few kilobytes."""

import math
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file
from tiny_prior import save_walking_density

import priors
from mapctl.metrics.realism import ClassifierSettings, RealismSettings
from priors.refiner import RefinerConfig
from priors.training import data as corpora
from priors.training.loop import train
from priors.training.recipes.refiner import (
    AdversarialSettings,
    AdversarialTrainer,
    RefinerEvaluator,
    RefinerRecipe,
    compute_realism_gap,
    sample_corpus,
)

TINY = RefinerConfig(width=6, memory=5, lookahead=1, joints=("hips", "rightToes"))
SETTINGS = AdversarialSettings(
    steps=6, window=10, batch=4, warm_up=1, head_start=1, critic_updates=1, history=8, critic_width=6, critic_around=1
)


@pytest.fixture(scope="module")
def density(tmp_path_factory):
    return str(save_walking_density(tmp_path_factory.mktemp("density") / "walks.safetensors"))


@pytest.fixture
def request_in(data, density):
    """Checkpoints in every round, so that a kill can come anywhere; news and measures rarely."""

    def made(out, **changes):
        settings = replace(SETTINGS, **changes.pop("settings", {}))
        given = {
            "checkpoint_minutes": 0.0,
            "report_steps": 2,
            "validate_steps": 4,
            "samples": 6,
            "judged": 2,
            "seconds": 1.2,
            "density": density,
            "config": TINY,
        } | changes
        return RefinerRecipe(data, out, settings=settings, **given)

    return made


def test_samples_go_on_from_the_clips_they_are_drawn_with(data, density, tmp_path):
    prior = priors.load(density)
    clips = corpora.read_corpus(data, match="", cache=tmp_path)
    drawn = [sample_corpus(prior, clips, 4, 20, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert drawn[0].lengths == (20,) * 4
    assert drawn[0].features.shape == (80, clips.features.shape[1])
    assert torch.equal(drawn[0].features, drawn[1].features)
    assert not torch.equal(drawn[0].features, drawn[2].features)
    short = corpora.Corpus(("a", "b"), (59, 60), clips.features[:119])
    assert sample_corpus(prior, short, 3, 5, torch.Generator()).lengths == (5,) * 3  # all after the longer


@pytest.fixture
def scripted(monkeypatch):
    """Rounds that mark a bias with their number and tell the losses given; the measures are given round by round."""

    def play(losses, scores):
        step = AdversarialTrainer.train_step

        def train_step(trainer):
            step(trainer)
            with torch.no_grad():
                trainer.network.last.bias.fill_(trainer.step)
            return losses(trainer.step)

        def judged(judge, network):
            return {"jitter_m_s3_ratio": scores.get(round(network.last.bias[0].item()), 9.0)}

        monkeypatch.setattr(AdversarialTrainer, "train_step", train_step)
        monkeypatch.setattr(RefinerEvaluator, "__call__", judged)

    return play


def even(number):
    return {"refiner": 0.7, "critic": 0.69, "told": 0.5, "updates": 1}


def kept(path):
    """Which round's refiner was exported."""
    return int(load_file(path)["last.bias"][0])


@pytest.mark.slow
def test_the_best_refiner_seen_is_exported(tmp_path, request_in, scripted):
    scripted(even, {0: 2.0, 2: 1.5, 4: 1.1, 6: 0.5})
    path = train(request_in(tmp_path / "run", validate_steps=2))
    assert kept(path) == 4
    card = priors.load_refiner(str(path)).card
    assert card.quality == {"step": 4, "test": {"jitter_m_s3_ratio": 1.1}}


def test_a_refiner_is_chosen_by_other_clips_than_it_is_measured_on(tmp_path, request_in, scripted, monkeypatch):
    """By the measures of a card no refiner was chosen."""
    scripted(even, dict.fromkeys(range(7), 1.0))
    shown, make_judge = [], RefinerEvaluator.of

    def note(raw, held, settings):
        shown.append(held.names)
        return make_judge(raw, held, settings)

    monkeypatch.setattr(RefinerEvaluator, "of", note)
    train(request_in(tmp_path / "run"))
    (chosen_by,), (measured_on,) = shown
    assert chosen_by != measured_on


@pytest.mark.slow
def test_it_stops_with_the_best_when_the_critic_has_won(tmp_path, request_in, scripted):
    news = []
    scripted(lambda number: even(number) | {"told": 1.0 if number > 4 else 0.5}, {0: 2.0, 4: 1.2, 8: 1.0})
    request = request_in(tmp_path / "run", settings={"steps": 20})
    assert kept(train(request, news.append)) == 4
    assert news[-1] == "the critic has won: training ends with the best weights so far"


def test_scores_are_distances_from_mocap():
    assert compute_realism_gap({"a_ratio": 1.0, "b_ratio": 1.0, "told_apart": 0.4, "round": 7}) == 0
    assert compute_realism_gap({"a_ratio": 2.0}) == compute_realism_gap({"a_ratio": 0.5}) == pytest.approx(math.log(2))
    assert compute_realism_gap({"a_ratio": 1.0, "told_apart": 0.8}) == pytest.approx(0.6)
    assert compute_realism_gap({"a_ratio": None}) == math.inf


@pytest.mark.slow
def test_the_judge_measures_against_clips_kept_from_training(data, density, tmp_path):
    clips = corpora.read_corpus(data, match="", cache=tmp_path)
    parts = corpora.split_corpus(clips, 1)
    raw = corpora.Corpus(("a", "b"), (80, 80), parts.validation.features.repeat(2, 1))
    quick = RealismSettings(classifier=ClassifierSettings(folds=2, steps=5, width=4, batch=8), dims=2)
    trainer = AdversarialTrainer(TINY, SETTINGS, parts.train, raw)
    row = RefinerEvaluator.of(raw, parts.validation, quick)(trainer.refiner)
    assert row["jitter_m_s3_ratio"] == pytest.approx(1, abs=1e-3)  # the very same clips
    assert row["contact_speed_cm_s_ratio"] == pytest.approx(1, abs=1e-3)
    assert "told_apart" not in row  # two clips are too few
    made = corpora.Corpus(tuple("abcd"), (80,) * 4, parts.validation.features.repeat(4, 1))
    judge = RefinerEvaluator.of(made, clips, quick)
    first, again = judge(trainer.refiner), judge(trainer.refiner)
    assert 0 <= first["told_apart"] <= 1
    assert first == again
