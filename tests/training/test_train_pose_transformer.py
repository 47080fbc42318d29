"""What `mapctl train pose-transformer` is made of; its runs are tested in test_runs."""

import math
from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import corpus, run
from tiny_transformer import CONFIG, network

import mapctl
from mapctl.inbetweening.partial_motion import KnownParts
from priors import checkpoints
from priors.pose_transformer import PoseTransformerConfig
from priors.training.recipes.lstm_gmm import DensityRecipe
from priors.training.recipes.pose_transformer import (
    PoseTransformerRecipe,
    PoseTransformerSettings,
    PoseTransformerTrainer,
    compute_losses,
    hide,
)
from priors.training.windows import PoseWindows, add_targets

SETTINGS = PoseTransformerSettings(steps=6, batch=100, window=32)


def windows_of(data, frames=40, batch=4):
    windows = PoseWindows(data, kinds=(), evenness=0.0)
    return add_targets(windows.draw(batch, frames, torch.Generator().manual_seed(0)))


def with_gap(truth, start, stop):
    known = torch.ones(truth.heading.shape, dtype=torch.bool)
    known[:, start:stop] = False
    return replace(truth, known=KnownParts.whole(known))


def losses_of(truth, hidden, **settings):
    return compute_losses(network(), truth, hidden, replace(SETTINGS, **settings))


def test_a_true_proposal_costs_nothing_but_contacts_and_spread():
    truth = windows_of(corpus(2, 60))
    parts = losses_of(truth, truth)
    assert parts["places_cm"] < 1e-2
    assert parts["pace_cm"] < 1e-2
    assert parts["turns"] < 1e-2
    assert losses_of(truth, with_gap(truth, 10, 20))["contacts_nats"] == pytest.approx(math.log(2), rel=1e-3)


def test_the_error_is_the_interpolation_s_while_it_is_untrained():
    truth = windows_of(corpus(2, 60))
    hidden = with_gap(truth, 10, 25)
    shown = hide(network(), hidden)
    apart = (shown.world_poses()[0] - truth.world_poses()[0])[:, 10:25].norm(dim=-1)
    parts = losses_of(truth, hidden)
    assert float(parts["places_cm"]) == pytest.approx(100 * float(apart.mean()), rel=1e-3)
    assert float(parts["share"]) == pytest.approx(1, rel=1e-2)


@pytest.mark.slow
def test_the_loss_falls_on_windows_that_it_sees_again_and_again():
    settings = PoseTransformerSettings(
        steps=60, batch=120, window=32, learning_rate=5e-3, variation=replace(SETTINGS.variation, share=0.0)
    )
    trainer, rows = (
        PoseTransformerTrainer(PoseTransformerConfig(width=48, layers=2, heads=2), settings, corpus(1, 60)),
        [],
    )
    for _ in range(60):
        trainer.generator.manual_seed(1)  # the same windows with the same parts
        rows.append(trainer.train_step())
    for name in ("loss", "places_cm", "contacts_nats"):
        assert rows[-1][name] < 0.9 * rows[0][name], name
    assert all(math.isfinite(value) for row in rows for value in row.values())


@pytest.mark.slow
def test_validation_is_the_same_each_time_and_leaves_out_gaps_that_are_too_long():
    trainer = PoseTransformerTrainer(CONFIG, SETTINGS, corpus(1, 60))
    first, again = (trainer.validate(corpus(2, 60)) for _ in range(2))
    assert first == again
    assert {"error_10_45_cm", "share_1_5", "error_arm_cm"} < set(first)
    assert "error_10_60_cm" not in first
    assert first["share_10_15"] == pytest.approx(1, abs=1e-3)  # untrained


@pytest.mark.slow
def test_what_the_command_line_trains_fills_gaps(tmp_path, data):
    words = ["--steps", 2, "--batch", 60, "--window", 32, "--width", 25, "--quiet"]
    assert run("train", "pose-transformer", "--data", data, "-o", tmp_path / "run", *words, "--layers", 1) == 2
    words[words.index(25)] = 16
    assert run("train", "pose-transformer", "--data", data, "-o", tmp_path / "run", *words, "--layers", 1) == 0
    on_rig("daz", 45).save(tmp_path / "in.bvh")
    words = ["--gap", "20:30", "--method", "transformer", "--inbetweener", tmp_path / "run", "--quiet"]
    assert run("infill", tmp_path / "in.bvh", "-o", tmp_path / "out.bvh", *words) == 0
    assert mapctl.load(tmp_path / "out.bvh").num_frames == 45
    words[words.index("transformer")] = "infiller"
    assert run("infill", tmp_path / "in.bvh", "-o", tmp_path / "no.bvh", *words) == 2


@pytest.mark.parametrize("recipe", [PoseTransformerRecipe, DensityRecipe])
def test_a_run_that_goes_on_from_a_model_keeps_out_what_was_kept_from_that(recipe, tmp_path):
    """With another seed it would train on the clips that its tables are measured on."""
    held = checkpoints.Card("any", {}, licence="none", data={"split_seed": 7}, **checkpoints.Card.layout_fields())
    checkpoints.save({"one": torch.zeros(1)}, held, tmp_path / "init.safetensors")
    made = recipe(data=tmp_path, out=tmp_path / "run", init=str(tmp_path / "init.safetensors"))
    assert made.split_seed == 7
    assert replace(made, init=None).split_seed == made.settings.seed
