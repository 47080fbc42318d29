"""`mapctl train keyframe-timing`: the fit, what it writes, and who uses it. Its runs are tested in test_runs."""

import json
import math
from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import corpus, generator, run
from safetensors.torch import load_file

import priors
from mapctl.errors import CheckpointError
from mapctl.inbetweening.pose_pairs import PosePairs
from priors.keyframe_timing import KeyframeTimingConfig
from priors.training.loop import train
from priors.training.recipes.keyframe_timing import (
    KeyframeTimingRecipe,
    KeyframeTimingSettings,
    KeyframeTimingTrainer,
    solve_weights,
)

SETTINGS = KeyframeTimingSettings()


def test_the_fit_finds_the_weights_that_pairs_were_made_by_but_for_a_few_wild_ones():
    features = torch.randn(2000, 4, generator=generator(), dtype=torch.float64)
    features[:, 0] = 1
    features[:, 2] = 5 + 0.1 * features[:, 2]
    wanted = torch.tensor([0.3, -0.2, 0.5, 0.1]).double()
    seconds = torch.exp(features @ wanted)
    seconds[::50] *= 20
    pairs, found = PosePairs(features, torch.ones(2000), seconds), None
    for _ in range(SETTINGS.steps):
        found = solve_weights(pairs, found, SETTINGS)
    assert found is not None
    assert torch.allclose(features @ found, features @ wanted, atol=0.02)


def test_four_of_five_of_its_own_pairs_lie_within_its_bounds():
    trainer = KeyframeTimingTrainer(KeyframeTimingConfig(), replace(SETTINGS, pairs=40), corpus(3, 90))
    rows = [trainer.train_step() for _ in range(5)]
    assert 1 < rows[-1]["half_off_by"] <= rows[0]["half_off_by"] * 1.1
    low, _, high = trainer.network(trainer.pairs.features, trainer.pairs.metres).unbind(dim=-1)
    inside = (trainer.pairs.seconds >= low) & (trainer.pairs.seconds <= high)
    assert float(inside.double().mean()) == pytest.approx(0.8, abs=0.03)
    assert {"pairs", "half_off_by", "within"} <= set(trainer.validate(corpus(2, 80)))


def test_a_run_leaves_float32_weights_with_a_complete_card(tmp_path, data):
    news = []
    path = train(KeyframeTimingRecipe(data, tmp_path / "run", licence="CC0"), news.append)
    assert news[-2].startswith("step 15/15: half_off_by 1.")
    assert {tensor.dtype for tensor in load_file(path).values()} == {torch.float32}
    card = priors.load_keyframe_timing(str(tmp_path / "run")).card
    assert (card.kind, card.licence, card.data["pairs"]) == ("keyframe-timing", "CC0", 3 * 5)
    assert math.isfinite(card.quality["test"]["half_off_by"])
    assert set(card.data["held_out"]) == {"validation", "test"}


def test_a_card_of_other_features_is_refused(tmp_path, data):
    path = train(KeyframeTimingRecipe(data, tmp_path))
    card = json.loads(path.with_suffix(".json").read_text())
    card["config"]["features"] = card["config"]["features"][:-1]
    path.with_suffix(".json").write_text(json.dumps(card))
    with pytest.raises(CheckpointError, match="a keyframe timing looks at one, way"):
        priors.load_keyframe_timing(str(path))
    with pytest.raises(CheckpointError, match="a denoiser is no keyframe timing"):
        priors.load_keyframe_timing("denoiser")


@pytest.mark.slow
def test_what_the_command_line_fits_suggests_a_timing(tmp_path, data, capsys):
    assert run("train", "keyframe-timing", "--data", data, "-o", tmp_path / "run", "--quiet") == 0
    on_rig("bandai", 40).save(tmp_path / "in.bvh")
    words = ["tween", tmp_path / "in.bvh", "-o", tmp_path / "out.bvh", "--keyframes", "0,39", "--method", "slerp"]
    assert run(*words, "--suggest-timing", "--timing", tmp_path / "run") == 0
    assert "suggested" in capsys.readouterr().out
    assert run(*words, "--timing", tmp_path / "run") == 2
    assert "--suggest-timing" in capsys.readouterr().err
