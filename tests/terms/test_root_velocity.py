"""Travel: nothing for the wanted velocity, half squares in sigmas for what is missed along, across and in facing."""

import math
from dataclasses import replace

import pytest
import torch

from mapctl.features import LAYOUT, GroundPose
from mapctl.terms import RootVelocity
from mapctl.terms.trial import Trial

FRAMES, PAST = 40, 30


def gliding(speed: float, direction: float, *, facing: float = 0.0) -> Trial:
    """A T-pose that glides at a velocity, now and before."""
    features = torch.zeros(1, FRAMES, LAYOUT.size, dtype=torch.float64)
    angle = torch.tensor(direction - facing, dtype=torch.float64)
    step = speed / 30
    features[..., LAYOUT.slices["root_displacement_heading"]] = step * torch.stack([angle.sin(), angle.cos()])
    features[..., LAYOUT.slices["root_height"]] = 0.9
    before = torch.zeros(PAST, 21, 3, dtype=torch.float64)
    back = -step * torch.arange(PAST - 1, -1, -1)
    before[..., 0] = (back * math.sin(direction))[:, None]
    before[..., 2] = (back * math.cos(direction))[:, None]
    place = GroundPose(torch.zeros(2, dtype=torch.float64), torch.tensor(facing, dtype=torch.float64))
    bits = torch.zeros(1, FRAMES, 2, dtype=torch.bool)
    return Trial(features, place, contacts=bits, before=before)


def wanting(speed: float, direction: float, **more) -> RootVelocity:
    velocity = speed * torch.tensor([math.sin(direction), math.cos(direction)], dtype=torch.float64)
    return RootVelocity(velocity.expand(FRAMES, 2), velocity.expand(PAST, 2), **more)


@pytest.mark.parametrize("direction", [0.0, 2.0, -3.0])
def test_the_wanted_velocity_costs_nothing_whichever_way_it_goes(direction):
    trial = gliding(1.3, direction, facing=0.4)
    assert float(wanting(1.3, direction)(trial).max()) < 1e-12
    assert float(wanting(1.3, direction).residual(trial).max()) < 1e-6


def test_too_slow_costs_under_the_sigma_of_speed():
    energy = wanting(1.5, 0.7, sigma_speed=0.2)(gliding(1.2, 0.7))
    torch.testing.assert_close(energy, torch.full((1, FRAMES), 0.5 * 1.5**2).double())


def test_facing_is_an_angle():
    for turns in (0, 3):
        facing = torch.full((FRAMES,), 0.3 + 2 * math.pi * turns, dtype=torch.float64)
        energy = wanting(1.0, 0.0, facing=facing, sigma_facing=0.5)(gliding(1.0, 0.0, facing=0.1))
        torch.testing.assert_close(energy, torch.full((1, FRAMES), 0.5 * 0.4**2).double())


def test_what_was_missed_before_the_window_is_owed():
    """After a stretch at half the speed, the first frames cost though they are as wanted; the last do not."""
    slow = gliding(0.6, 0.0)
    late = replace(slow, features=gliding(1.2, 0.0).features)
    energy = wanting(1.2, 0.0)(late)[0]
    assert float(energy[0]) > 1
    assert float(energy[-5:].max()) < 1e-9
