"""Signs and means of rotations under noise that turns joints by more than half a turn from frame to frame."""

import math

import pytest
import torch

from mapctl import rotations
from mapctl.recording.noise_estimation import average_over_time, choose_continuous_signs, estimate_angle_noise


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


def test_the_mean_over_time_is_that_of_rotations_whatever_their_signs():
    quats = rotations.from_rotation_vector(torch.tensor([0.4, -0.3, 1.0], dtype=torch.float64)).expand(60, 2, 4)
    noisy = add_noise(quats, 0.3)
    noisy = noisy * torch.where(torch.rand(60, 2, 1, generator=torch.Generator().manual_seed(1)) < 0.5, -1.0, 1.0)
    away = rotations.multiply(rotations.inverse(quats), average_over_time(noisy, torch.ones(60, 2, dtype=torch.bool)))
    assert rotations.to_rotation_vector(away).norm(dim=-1).max() < 0.35


@pytest.mark.parametrize("sigma", [0.05, 0.15, 0.3, 0.5, 0.7, 0.9])
def test_noise_is_estimated_whatever_its_size(sigma):
    noisy = add_noise(swing(600, 4), sigma)
    found = estimate_angle_noise(noisy, torch.ones(noisy.shape[:2], dtype=torch.bool))
    torch.testing.assert_close(found, torch.full_like(found, sigma), rtol=0.15, atol=0.0)
