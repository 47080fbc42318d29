"""What `mapctl train denoiser` is made of; its runs are tested in test_runs."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import corpus, generator

from mapctl.features import LAYOUT
from priors.denoiser import DenoiserConfig
from priors.training.augment import CorruptionSettings
from priors.training.data import Corpus
from priors.training.recipes.denoiser import DenoiserSettings, DenoiserTrainer, compute_denoiser_losses, draw_performers
from priors.training.windows import FeatureWindows, PoseVariation

TINY = DenoiserConfig(width=8, dilations=(1, 2))
FAMILIAR = PoseVariation(share=0.0, tilted=0.0)
SETTINGS = DenoiserSettings(steps=6, batch=3, window=16)


def drawn_of(data, settings, seed=0):
    return draw_performers(FeatureWindows(data, settings.window, evenness=settings.evenness), settings, generator(seed))


def test_windows_are_clips_mirrored_half_of_the_time():
    plain = replace(SETTINGS, calibration_deg=0.0, poses=FAMILIAR, batch=64, corruption=CorruptionSettings(size=0.0))
    whole = corpus(2, 40)
    drawn = drawn_of(whole, plain)
    assert drawn.shape == (64, 16, LAYOUT.size)
    every = whole.features.unfold(0, 16, 1).transpose(1, 2)
    same = torch.cdist(drawn.flatten(1), every.flatten(1)).amin(dim=1) < 1e-3
    assert 0.3 < same.double().mean() < 0.7
    assert torch.equal(drawn, drawn_of(whole, plain))
    assert not torch.equal(drawn, drawn_of(whole, plain, seed=1))


def test_a_rig_calibrated_otherwise_stands_as_still(monkeypatch):
    """Joint frames turned by a constant: what does not move still does not, the hips' place stays."""
    still = corpus(1, 16).features[:1].expand(16, -1).contiguous()
    settings = replace(
        SETTINGS, poses=FAMILIAR, batch=20, calibration_deg=10.0, corruption=CorruptionSettings(size=0.0)
    )
    drawn = drawn_of(Corpus(("a",), (16,), still), settings)
    joints = LAYOUT.pick(drawn, "joint_rotations")
    assert torch.diff(joints, dim=1).abs().max() < 1e-5
    turned = (joints - joints[:1]).abs().amax(dim=(1, 2)) > 0.05
    assert 0.2 < turned.double().mean() < 1


def test_a_perfect_proposal_costs_nothing_but_contacts():
    from tiny_denoiser import network

    clean = replace(
        SETTINGS, corruption=CorruptionSettings(clean=1.0, markers=0.0, spikes=0.0, dropout=0.0, limb=0.0, gap=0.0)
    )
    parts = compute_denoiser_losses(network(), corpus(1, 30).features[None], clean, generator())
    assert parts["error_cm"] < 0.05
    assert parts["angles_deg"] < 0.01
    assert parts["contacts_nats"] == pytest.approx(math.log(2), rel=1e-3)  # untrained it does not know
    contacts, spread = clean.contacts * parts["contacts_nats"], clean.spread * parts["spread_nats"]
    assert parts["loss"] == pytest.approx(float(contacts + spread), abs=0.1)


@pytest.mark.slow
def test_the_loss_falls_on_windows_that_it_sees_again_and_again():
    settings = DenoiserSettings(steps=50, batch=6, window=24, learning_rate=3e-3)
    trainer = DenoiserTrainer(DenoiserConfig(width=24, dilations=(1, 2)), settings, corpus(1, 30))
    rows = []
    for _ in range(50):
        trainer.generator.manual_seed(1)  # the same windows, spoilt in the same way
        rows.append(trainer.train_step())
    for name, share in (("loss", 0.6), ("error_cm", 0.6), ("contacts_nats", 0.9)):
        assert rows[-1][name] < share * rows[0][name]


def test_validation_is_the_same_each_time():
    trainer = DenoiserTrainer(TINY, SETTINGS, corpus(1, 30))
    first, again = (trainer.validate(corpus(2, 30)) for _ in range(2))
    assert first == again
    assert set(first) == {"loss", "error_cm", "feet_cm_frame", "angles_deg", "contacts_nats", "spread_nats"}
