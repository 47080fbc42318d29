"""Smoothing as wide as the noise asks for, and what of a rest goes back."""

import math

import pytest
import torch
from captures import DEGREE, apart_deg, shaken, swaying
from helpers import generator

from mapctl.recording.residual_motion import restore_residual_motion
from mapctl.recording.sure_smoothing import smooth_rotations


def even(degrees, joints=6):
    return torch.full((joints,), degrees * DEGREE, dtype=torch.float64)


def test_without_noise_nothing_is_changed():
    quats = swaying(200, highest=4.0)
    assert apart_deg(smooth_rotations(quats, even(0)), quats).max() < 1e-5


@pytest.mark.parametrize("highest", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("degrees", [1, 3, 8])
def test_the_error_shrinks_for_slow_and_for_fast_motion(degrees, highest):
    truth = swaying(300, highest=highest)
    noisy = shaken(truth, degrees * DEGREE)
    before, after = apart_deg(truth, noisy).mean(), apart_deg(truth, smooth_rotations(noisy, even(degrees))).mean()
    assert after < 0.75 * before
    if highest == 0.5:
        assert after < 0.45 * before


def test_each_joint_is_smoothed_by_its_own_noise():
    truth, sigma = swaying(300), even(4)
    sigma[:3] = 0
    noisy = shaken(truth, sigma)
    away = apart_deg(smooth_rotations(noisy, sigma), truth).mean(dim=0)
    assert (away[:3] < 1e-5).all()
    assert (away[3:] < 0.5 * apart_deg(noisy, truth).mean(dim=0)[3:]).all()


def test_what_is_as_fast_as_noise_but_far_larger_stays():
    """A tremble of 60 degrees at 10 Hz beside noise of one."""
    time = torch.arange(300, dtype=torch.float64) / 30
    swing = torch.zeros(300, 1, 3, dtype=torch.float64)
    swing[:, 0, 0] = 60 * DEGREE * torch.sin(2 * math.pi * 10 * time)
    from mapctl import rotations

    truth = rotations.from_rotation_vector(swing)
    assert apart_deg(smooth_rotations(shaken(truth, DEGREE), even(1, 1)), truth).mean() < 3


@pytest.mark.parametrize("frames", [1, 2, 3, 10])
def test_short_recordings_are_smoothed_as_far_as_they_reach(frames):
    quats = shaken(swaying(frames), 3 * DEGREE)
    assert smooth_rotations(quats, even(3)).shape == quats.shape


def rest_of(sigma_deg, frames=400, seed=0):
    noise = torch.randn(frames, 6, 3, generator=generator(seed), dtype=torch.float64)
    return sigma_deg * DEGREE * noise


def seen_all(frames=400):
    return torch.ones(frames, 6, dtype=torch.bool)


def test_of_a_white_rest_almost_nothing_goes_back():
    rest = rest_of(3)
    back, share = restore_residual_motion(rest, seen_all(), even(3))
    assert back.square().mean() < 0.01 * rest.square().mean()
    assert share.mean() < 0.1


@pytest.mark.parametrize("sigmas", [2, 5, 10])
def test_of_a_motion_that_was_missed_most_goes_back(sigmas):
    time = torch.arange(400, dtype=torch.float64) / 30
    missed = (sigmas * 3 * DEGREE * torch.sin(2 * math.pi * 0.7 * time))[:, None, None].expand(400, 6, 3)
    back, share = restore_residual_motion(missed + rest_of(3), seen_all(), even(3))
    assert (back - missed).square().mean() < 0.35 * missed.square().mean()
    if sigmas >= 5:
        assert (back - missed).square().mean() < 0.1 * missed.square().mean()
        assert share.mean() > 0.9
    # Better than the model alone, and than the capture itself.
    assert (back - missed).square().mean() < (3 * DEGREE) ** 2


def test_only_the_joint_that_the_model_misses_is_given_back_and_only_while_it_does():
    time = torch.arange(400, dtype=torch.float64)
    missed = torch.zeros(400, 6, 3, dtype=torch.float64)
    missed[:, 2] = (0.5 * torch.exp(-0.5 * ((time - 100) / 15).square()))[:, None]
    back, share = restore_residual_motion(missed + rest_of(3), seen_all(), even(3))
    assert share[85:115, 2].min() > 0.9
    assert share[250:, 2].mean() < 0.15
    others = [0, 1, 3, 4, 5]
    assert share[:, others].mean() < 0.1
    assert (back - missed)[:, 2].square().mean() < 0.1 * missed[:, 2].square().mean()


def test_where_nothing_was_seen_the_rest_says_nothing():
    rest, seen = rest_of(3), seen_all()
    seen[100:140, 1] = False
    seen[:, 4] = False
    wild = torch.where(seen[..., None], rest, 50.0)
    for found, wanted in zip(
        restore_residual_motion(wild, seen, even(3)), restore_residual_motion(rest, seen, even(3)), strict=True
    ):
        assert torch.equal(found, wanted)
        assert found.isfinite().all()
    assert restore_residual_motion(wild, seen, even(3))[0][:, 4].abs().max() < 1e-6


def test_without_noise_nothing_goes_back():
    sigma = even(3)
    sigma[0] = 0
    back, share = restore_residual_motion(rest_of(20), seen_all(), sigma)
    assert not back[:, 0].any()
    assert not share[:, 0].any()
    assert back[:, 1:].any()
    back, share = restore_residual_motion(rest_of(20), seen_all(), even(0))
    assert not back.any()
    assert not share.any()


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_short_rests_break_nothing(frames):
    back, share = restore_residual_motion(rest_of(3, frames), seen_all(frames), even(3))
    assert back.shape == (frames, 6, 3)
    assert share.shape == (frames, 6)
    assert back.isfinite().all()
