"""Training of a stitcher: latents that come nearest, and the temperature of draws."""

from dataclasses import replace

import numpy as np
import pytest
import tiny_stitcher
import torch
from helpers import corpus, write_corpus

import priors
from priors.stitcher import DrawnLatents, count_made, join_sides, walk_sides
from priors.training.loop import train
from priors.training.recipes import stitcher as recipe_module
from priors.training.recipes.stitcher import (
    TEMPERATURES,
    TRIES,
    Known,
    StitcherRecipe,
    StitcherSettings,
    Transition,
    TransitionWindows,
    calibrate_temperature,
    interpolate,
    place,
    sample_nearest,
)

SETTINGS = StitcherSettings(steps=10, batch=6, window=24)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


BARE = Known()


def transitions(count=6, frames=20, known=BARE) -> Transition:
    return TransitionWindows(corpus(2, 80), kinds=(), evenness=0.0).draw(count, frames, known, seeded())


@pytest.mark.slow
def test_the_nearest_of_several_draws_is_kept():
    network, truth, count = tiny_stitcher.network(drawn=1.0), transitions(8), 8
    nearest = sample_nearest(network, truth, seeded())
    made = nearest.slow.shape[2]
    tried = DrawnLatents.sample(network.config, TRIES * count, made, seeded())

    def measure(latents):
        away = walk_sides(network, truth.ends(), truth.frames, latents).place_joints() - truth.place_joints(made)
        return away.norm(dim=-1).mean(dim=(0, 2, 3))

    every = torch.stack([measure(tried.rows(torch.arange(count) + count * number)) for number in range(TRIES)])
    torch.testing.assert_close(measure(nearest), every.amin(dim=0))
    assert float((every.amax(dim=0) - every.amin(dim=0)).min()) > 1e-4


@pytest.mark.slow
def test_the_temperature_is_the_largest_at_which_the_best_draw_is_as_near_as_any():
    """By numpy, of answers that are drawn and placed anew, in the one gap that these clips have room for."""
    network = tiny_stitcher.network(drawn=0.3)
    windows = TransitionWindows(corpus(2, 60), kinds=(), evenness=0.0)
    found = calibrate_temperature(network, windows)
    truth = windows.draw(96, 16, BARE, torch.Generator().manual_seed(15))
    places = interpolate(truth)[0].joints_world()[:, :-1].numpy()
    made, scores = count_made(network, 16), {}
    for temperature in TEMPERATURES:
        draws, generator = [], torch.Generator().manual_seed(0)
        for _ in range(8):
            noise = DrawnLatents.sample(network.config, 96, made, generator)
            scaled = DrawnLatents(temperature * noise.shared, temperature * noise.slow)
            draws.append(place(join_sides(walk_sides(network, truth.ends(), 16, scaled))).numpy())
        away = np.stack([np.linalg.norm(draw - places, axis=-1).mean(axis=(1, 2)) for draw in draws])
        scores[temperature] = away.min(axis=0).mean()
    assert found == max(each for each, score in scores.items() if score <= 1.01 * min(scores.values()))


@pytest.mark.slow
def test_a_run_writes_the_temperature_that_it_finds(tmp_path, monkeypatch):
    monkeypatch.setattr(recipe_module, "calibrate_temperature", lambda network, windows: 2.5)
    data = write_corpus(tmp_path / "data")
    settings = replace(SETTINGS, steps=2)
    train(StitcherRecipe(data, tmp_path / "run", config=tiny_stitcher.CONFIG, settings=settings))
    assert float(priors.load_stitcher(str(tmp_path / "run")).network.temperature) == 2.5
