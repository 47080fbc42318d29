"""Spoilt copies of clean motion: what is asked for happens, and nothing else."""

from dataclasses import replace

import pytest
import torch
from helpers import corpus, generator

from mapctl import rotations
from mapctl.features import LAYOUT
from mapctl.skeleton import CANONICAL
from priors.training.augment import LIMBS, CorruptionSettings, corrupt, make_clean_capture

JOINTS = CANONICAL.num_joints
NOTHING = CorruptionSettings(
    clean=1.0, uneven=0.0, markers=0.0, correlated=0.0, spikes=0.0, dropout=0.0, limb=0.0, gap=0.0, told=0.0
)
PLAIN = replace(NOTHING, clean=0.0)
BATCH, FRAMES = 40, 50


@pytest.fixture(scope="module")
def clean():
    features = corpus().features
    starts = torch.arange(BATCH) * 10 % (len(features) - FRAMES)
    return make_clean_capture(torch.stack([features[start : start + FRAMES] for start in starts.tolist()]))


def spoilt(clean, settings=NOTHING, seed=0):
    return corrupt(clean, settings, generator(seed))


def turned_deg(clean, other):
    """By joint the angle that was added (batch, frames, joints)."""
    both = []
    for capture in (clean, other):
        quats = rotations.from_rotation_vector(capture.joints)
        both.append(torch.cat([capture.hips[:, :, None], quats], dim=2))
    turn = rotations.multiply(rotations.inverse(both[0]), both[1])
    return torch.rad2deg(rotations.to_rotation_vector(turn))


def test_a_clean_capture_is_the_features():
    features = corpus().features[None, :60]
    capture = make_clean_capture(features)
    assert capture.seen.all()
    assert capture.seen_root.all()
    assert not capture.sigma.any()
    assert torch.equal(capture.root[..., 1:2], LAYOUT.pick(features, "root_height"))
    assert torch.equal(capture.joints.flatten(2), LAYOUT.pick(features, "joint_rotations"))
    assert torch.allclose(capture.tilt, LAYOUT.pick(features, "root_tilt"), atol=1e-5)
    turn = torch.diff(capture.heading[0])
    assert torch.allclose(turn, LAYOUT.pick(features, "heading_change")[0, 1:, 0], atol=1e-5)


def test_where_nothing_is_asked_for_nothing_changes(clean):
    same = spoilt(clean)
    assert turned_deg(clean, same).abs().max() < 0.1
    assert torch.equal(same.root, clean.root)
    assert same.seen.all()
    assert same.seen_root.all()
    assert not same.sigma.any()
    assert not same.sigma_root.any()


def test_a_seed_draws_the_same_and_another_something_else(clean):
    first, again, other = (spoilt(clean, CorruptionSettings(), seed) for seed in (3, 3, 4))
    for name in ("root", "hips", "joints", "seen_root", "seen", "sigma_root", "sigma"):
        assert torch.equal(getattr(first, name), getattr(again, name))
        assert not torch.equal(getattr(first, name), getattr(other, name)) or name == "seen_root"


def test_the_sigmas_told_are_those_of_the_noise(clean):
    noisy = spoilt(clean, replace(PLAIN, angle_deg=(2.0, 9.0), root_cm=(1.0, 5.0)))
    turned = turned_deg(clean, noisy)
    found = turned.square().mean(dim=(1, 3)).sqrt() / torch.rad2deg(noisy.sigma)
    assert found.mean() == pytest.approx(1, abs=0.05)
    assert (torch.rad2deg(noisy.sigma) >= 1.99).all()
    assert (torch.rad2deg(noisy.sigma) <= 9.01).all()
    apart = (noisy.root - clean.root).square().mean(dim=(1, 2)).sqrt() / noisy.sigma_root
    assert apart.mean() == pytest.approx(1, abs=0.05)
    assert (noisy.sigma_root >= 0.0099).all()
    assert (noisy.sigma_root <= 0.0501).all()


def test_spikes_that_are_found_are_masked(clean):
    settings = replace(NOTHING, spikes=0.05, spike_deg=(30.0, 60.0))
    for found, masked in ((1.0, True), (0.0, False)):
        other = spoilt(clean, replace(settings, found=found))
        high = turned_deg(clean, other).norm(dim=-1) > 15
        assert 0.001 < high.double().mean() < 0.1
        assert bool((~other.seen[high]).all() if masked else other.seen.all())
        assert other.seen[~high].double().mean() > 0.995  # two axes may undo each other


def test_limbs_are_lost_together_and_for_one_while(clean):
    other = spoilt(clean, replace(NOTHING, limb=1.0))
    for window in ~other.seen:
        joints = tuple(window.any(dim=0).nonzero()[:, 0].tolist())
        assert joints in {tuple(sorted(limb)) for limb in LIMBS}
        frames = window[:, joints[0]]
        assert torch.equal(window[:, list(joints)], frames[:, None].expand(-1, len(joints)))
        assert (torch.diff(frames.int()) == 1).sum() <= 1
        assert (torch.diff(frames.int()) == -1).sum() <= 1
