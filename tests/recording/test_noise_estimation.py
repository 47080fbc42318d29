"""How noisy a recording is, told from the recording alone."""

import math

import pytest
import torch
from captures import DEGREE, shaken, swaying
from helpers import generator

from mapctl import rotations
from mapctl.recording.noise_estimation import estimate_angle_noise, estimate_position_noise


def all_seen(quats):
    return torch.ones(quats.shape[:2], dtype=torch.bool)


def told_deg(quats, seen=None):
    return torch.rad2deg(estimate_angle_noise(quats, all_seen(quats) if seen is None else seen))


def smooth_place(frames):
    time = torch.arange(frames, dtype=torch.float64) / 30
    return torch.stack([1.2 * time, 0.9 + 0.03 * torch.sin(9 * time), 0.2 * torch.sin(2 * time)], dim=-1)


@pytest.mark.parametrize("fps", [30, 120])
@pytest.mark.parametrize("degrees", [0.5, 1, 3, 8, 15])
def test_white_noise_of_angles_is_told(degrees, fps):
    quats = shaken(swaying(800, fps=fps), degrees * DEGREE)
    assert told_deg(quats).tolist() == pytest.approx([degrees] * 6, rel=0.12)


@pytest.mark.parametrize("centimetres", [0.1, 1, 5])
def test_white_noise_of_places_is_told(centimetres):
    places = smooth_place(800)
    noisy = places + centimetres / 100 * torch.randn(800, 3, generator=generator(), dtype=torch.float64)
    seen = torch.ones(800, dtype=torch.bool)
    assert 100 * estimate_position_noise(noisy, seen) == pytest.approx(centimetres, rel=0.12)


def test_smooth_motion_without_noise_has_none():
    assert told_deg(swaying(300)).max() < 0.05
    assert 100 * estimate_position_noise(smooth_place(300), torch.ones(300, dtype=torch.bool)) < 0.05


@pytest.mark.parametrize("order", ["ZXY", "XYZ"])
@pytest.mark.parametrize("degrees", [1, 2])
def test_angles_rounded_to_a_step_err_uniformly_by_it(degrees, order):
    """Joints that move by less than a step a frame rest for most frames, and are no less noisy for that."""
    quats, axes = swaying(400, fps=240), rotations.euler_axes([order] * 6)
    angles = rotations.to_euler(rotations.to_matrix(quats), axes) / (degrees * DEGREE)
    rounded = rotations.from_matrix(rotations.from_euler(angles.round() * degrees * DEGREE, axes))
    assert told_deg(rounded).tolist() == pytest.approx([degrees / math.sqrt(12)] * 6, rel=1e-6)
    assert told_deg(quats).max() < 0.05


def test_spikes_do_not_upset_it():
    quats = shaken(swaying(800), 2 * DEGREE)
    hit = (torch.rand(800, 6, generator=generator(3)) < 0.02)[..., None]
    assert told_deg(torch.where(hit, shaken(quats, 45 * DEGREE, seed=4), quats)).tolist() == pytest.approx(
        [2.0] * 6, rel=0.2
    )


def test_what_is_masked_does_not_matter():
    clean = shaken(swaying(400), 2 * DEGREE)
    seen = all_seen(clean)
    seen[100:160, 2] = False
    seen[200:205] = False
    wild = torch.where(seen[..., None], clean, shaken(clean, 2.0, seed=9))
    assert torch.equal(estimate_angle_noise(clean, seen), estimate_angle_noise(wild, seen))
    places = smooth_place(400) + 0.01 * torch.randn(400, 3, generator=generator(), dtype=torch.float64)
    thrown = torch.where(seen[:, 0, None], places, 100.0)
    assert estimate_position_noise(places, seen[:, 0]) == estimate_position_noise(thrown, seen[:, 0])
