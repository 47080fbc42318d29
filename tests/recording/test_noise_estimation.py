"""How noisy a recording is, by the recording alone; signs of quaternions under large noise."""

import math

import pytest
import torch
from captures import DEGREE, shaken, swaying
from helpers import generator

from mapctl import rotations
from mapctl.recording.noise_estimation import choose_continuous_signs, estimate_angle_noise, estimate_position_noise


def all_seen(quats):
    return torch.ones(quats.shape[:2], dtype=torch.bool)


def told_deg(quats, seen=None):
    return torch.rad2deg(estimate_angle_noise(quats, all_seen(quats) if seen is None else seen))


def smooth_place(frames):
    time = torch.arange(frames, dtype=torch.float64) / 30
    return torch.stack([1.2 * time, 0.9 + 0.03 * torch.sin(9 * time), 0.2 * torch.sin(2 * time)], dim=-1)


@pytest.mark.parametrize("fps", [30, 120])
@pytest.mark.parametrize("degrees", [0.5, 3, 15, 40])
def test_white_noise_of_angles_is_recognised(degrees, fps):
    quats = shaken(swaying(800, fps=fps), degrees * DEGREE)
    assert told_deg(quats).tolist() == pytest.approx([degrees] * 6, rel=0.12)


@pytest.mark.parametrize("centimetres", [0.1, 1, 5])
def test_white_noise_of_positions_is_recognised(centimetres):
    positions = smooth_place(800)
    noisy = positions + centimetres / 100 * torch.randn(800, 3, generator=generator(), dtype=torch.float64)
    seen = torch.ones(800, dtype=torch.bool)
    assert 100 * estimate_position_noise(noisy, seen) == pytest.approx(centimetres, rel=0.12)


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


def swing(frames: int = 400, joints: int = 3) -> torch.Tensor:
    """Joints that swing by 40 degrees about a bent pose, each at a pace of its own."""
    time = torch.arange(frames, dtype=torch.float64)[:, None] / 30
    angle = 1.2 + 0.7 * torch.sin(2 * math.pi * time * torch.linspace(0.3, 0.8, joints, dtype=torch.float64))
    return rotations.from_rotation_vector(torch.stack([angle, 0.3 * angle, 0 * angle], dim=-1))


def add_noise(quats: torch.Tensor, sigma: float, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = sigma * torch.randn(*quats.shape[:2], 3, generator=generator, dtype=torch.float64)
    return rotations.multiply(quats, rotations.from_rotation_vector(noise))


@pytest.mark.parametrize("seed", range(2))
def test_signs_stay_with_the_motion_where_the_frame_before_does_not_tell(seed):
    truth = rotations.make_sign_continuous(swing())
    noisy = add_noise(truth, 0.9, seed)
    chosen = choose_continuous_signs(noisy)
    side = (chosen * truth).sum(dim=-1).sign()
    assert (side == side[:1]).double().mean() > 0.98
    by_the_frame_before = (rotations.make_sign_continuous(noisy) * truth).sum(dim=-1).sign()
    assert (by_the_frame_before == by_the_frame_before[:1]).double().mean() < 0.9
