"""What `mapctl train infiller` is made of; its runs are tested in test_runs."""

import math
from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import corpus, generator, run
from tiny_infiller import CONFIG, network

import mapctl
from mapctl.skeleton import CANONICAL
from priors.infiller import InfillerConfig
from priors.training.recipes.infiller import GapSettings, InfillerSettings, InfillerTrainer, compute_infiller_losses
from priors.training.windows import PositionWindows

SETTINGS = InfillerSettings(steps=6, batch=4, window=32)


def windows_of(data, frames=60, batch=4):
    return PositionWindows(data, frames=frames, evenness=0.0).draw(batch, generator())


def with_hole(window, start, stop):
    known = window.present[..., None].expand(-1, -1, CANONICAL.num_joints).clone()
    known[:, start:stop] = False
    return known


def test_a_true_proposal_costs_nothing_but_contacts():
    window = windows_of(corpus(2, 60))
    everything = with_hole(window, 0, 0)
    parts = compute_infiller_losses(network(), window, everything, SETTINGS)
    assert parts["place"] == parts["pace"] == parts["feet_cm_frame"] == parts["error_cm"] == 0
    parts = compute_infiller_losses(network(), window, with_hole(window, 20, 40), SETTINGS)
    assert parts["contacts_nats"] == pytest.approx(math.log(2), rel=1e-3)  # untrained it does not know


def test_an_autoencoder_answers_for_what_it_was_shown_too():
    window = windows_of(corpus(2, 60))
    everything = with_hole(window, 0, 0)
    parts = compute_infiller_losses(network(config=replace(CONFIG, architecture="image")), window, everything, SETTINGS)
    assert parts["place"] > 0.1
    assert parts["error_cm"] == 0


@pytest.mark.parametrize("architecture", ["skips", "image"])
def test_a_few_steps_are_taken_with_any_network(architecture):
    trainer = InfillerTrainer(replace(CONFIG, architecture=architecture), replace(SETTINGS, batch=2), corpus(2, 40))
    before = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    rows = [trainer.train_step() for _ in range(3)]
    assert all(math.isfinite(value) for row in rows for value in row.values())
    after = trainer.network.state_dict()
    assert any(not torch.equal(after[name], value) for name, value in before.items())
    assert set(rows[0]) == {"loss", "place", "pace", "feet_cm_frame", "contacts_nats", "error_cm"}


@pytest.mark.slow
def test_the_loss_falls_on_windows_that_it_sees_again_and_again():
    config = InfillerConfig(widths=(24, 24, 24, 24, 24))
    gaps = GapSettings(shortest=15.0, longest=15.0, spread=1.0)
    settings = InfillerSettings(steps=60, batch=4, window=40, learning_rate=5e-3, gaps=gaps)
    trainer, rows = InfillerTrainer(config, settings, corpus(1, 60)), []
    for _ in range(60):
        trainer.generator.manual_seed(1)  # the same windows with the same gaps
        rows.append(trainer.train_step())
    for name in ("loss", "error_cm", "contacts_nats"):
        assert rows[-1][name] < 0.9 * rows[0][name], name


@pytest.mark.slow
def test_validation_is_the_same_each_time_and_compares_with_the_guess():
    settings = replace(SETTINGS, window=80)
    trainer = InfillerTrainer(CONFIG, settings, corpus(1, 100))
    first, again = (trainer.validate(corpus(2, 100)) for _ in range(2))
    assert first == again
    assert set(first) == {f"{name}_{gap}_cm" for name in ("error", "guess") for gap in (15, 30, 60)}
    assert all(first[f"error_{gap}_cm"] == first[f"guess_{gap}_cm"] for gap in (15, 30, 60))  # untrained
    assert 0 < first["guess_15_cm"] < first["guess_60_cm"]


def test_in_bfloat16_it_trains_too():
    trainer = InfillerTrainer(CONFIG, replace(SETTINGS, bfloat16=True), corpus(1, 40))
    assert all(math.isfinite(value) for _ in range(2) for value in trainer.train_step().values())
    assert all(value.dtype == torch.float32 for value in trainer.network.state_dict().values())


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["image"])
def test_what_the_command_line_trains_fills_gaps(tmp_path, data, architecture):
    words = ["--steps", 2, "--batch", 2, "--window", 32, "--architecture", architecture, "--quiet"]
    assert run("train", "infiller", "--data", data, "-o", tmp_path / "run", *words) == 0
    on_rig("daz", 45).save(tmp_path / "in.bvh")
    words = ["--gap", "20:30", "--inbetweener", tmp_path / "run", "--quiet"]
    assert run("infill", tmp_path / "in.bvh", "-o", tmp_path / "out.bvh", *words) == 0
    assert mapctl.load(tmp_path / "out.bvh").num_frames == 45
