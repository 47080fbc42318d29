"""Training of a density: its windows, its statistics, and what it learns."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import corpus, walk, write_corpus

from mapctl.features import LAYOUT, encode, mirror_features
from priors.lstm_gmm.network import PAPER, LstmGmmConfig
from priors.training.loop import train
from priors.training.recipes import lstm_gmm
from priors.training.recipes.lstm_gmm import (
    DensityRecipe,
    DensityTrainer,
    TrainingSettings,
    compute_feature_statistics,
    summarise_states,
)

TINY = LstmGmmConfig(width=8, components=2)
MEASURE = lstm_gmm.measure_free_runs
SETTINGS = TrainingSettings(steps=6, batch=4, window=20)


@pytest.mark.parametrize("recipe", ["ours", "paper"])
def test_steps_lower_the_loss(recipe):
    config = TINY if recipe == "ours" else replace(PAPER, width=8)
    settings = replace(SETTINGS, steps=400, batch=8, learning_rate=5e-3)
    trainer = DensityTrainer(config, settings, corpus())
    losses = [trainer.train_step()["loss"] for _ in range(60)]
    assert sum(losses[-5:]) < sum(losses[:5]) - 10


def test_statistics_are_symmetric_and_floored():
    mean, std = compute_feature_statistics(corpus().features)
    torch.testing.assert_close(mirror_features(mean[None])[0], mean, atol=1e-5, rtol=0)
    assert float(std.min()) >= 0.001
    assert bool((mean[LAYOUT.continuous :] == 0.5).all())
    assert bool((std[LAYOUT.continuous :] == 0.5).all())


def test_free_runs_are_compared_with_the_data():
    data = corpus()
    found = MEASURE(DensityTrainer(TINY, SETTINGS, data).network, data, runs=4, frames=40)
    assert found["free_run_finite"] == 1
    assert found["free_run_speed_ratio"] == pytest.approx(1, abs=0.3)
    assert found["free_run_height_ratio"] == pytest.approx(1, abs=0.1)
    summary = summarise_states(encode(walk(60))[0].float())
    assert summary["speed"] == pytest.approx(1.24, abs=0.02)


@pytest.mark.slow
def test_the_starts_of_a_density_are_chosen_by_its_labels(tmp_path, monkeypatch):
    write_corpus(tmp_path / "data")
    asked, select = [], lstm_gmm.select_initial_states
    monkeypatch.setattr(
        lstm_gmm, "select_initial_states", lambda *given, **named: asked.append(named) or select(*given, **named)
    )
    monkeypatch.setattr(lstm_gmm, "measure_free_runs", partial(MEASURE, runs=2, frames=20))
    labels = r"(?P<clip>\d)\.bvh"
    train(DensityRecipe(tmp_path / "data", tmp_path / "run", config=TINY, settings=SETTINGS, starts=4, labels=labels))
    (given,) = asked
    assert given["labels"].tolist() == torch.eye(len(given["labels"])).tolist()
