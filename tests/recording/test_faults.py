"""Frames that leap are found, fast swings are not."""

import math

import pytest
import torch
from captures import DEGREE, shaken, swaying
from helpers import generator, quat_xyzw

from mapctl import rotations
from mapctl.recording import inspection


def turned(quats, frames, joint, degrees):
    """A joint turned away in some frames."""
    vector = torch.zeros(len(frames), 3, dtype=torch.float64)
    vector[:, 1] = degrees * DEGREE
    out = quats.clone()
    out[frames, joint] = rotations.multiply(quats[frames, joint], rotations.from_rotation_vector(vector))
    return out


def find_angle_spikes(quats):
    return inspection.find_angle_spikes(quats, torch.ones(quats.shape[:2], dtype=torch.bool))


def find_position_spikes(places):
    return inspection.find_position_spikes(places, torch.ones(len(places), dtype=torch.bool))


@pytest.mark.parametrize("frames", [[40], [40, 41], [2], [97], [0], [99]], ids=str)
@pytest.mark.parametrize("sigma", [0.0, 1.0, 4.0])
def test_planted_spikes_are_found_and_nothing_else_is(frames, sigma):
    quats = turned(shaken(swaying(100), sigma * DEGREE), frames, 3, 60)
    found = find_angle_spikes(quats)
    wanted = torch.zeros_like(found)
    wanted[frames, 3] = True
    assert torch.equal(found, wanted)


def test_small_spikes_are_found_where_there_is_no_noise_and_left_to_what_treats_noise():
    assert find_angle_spikes(turned(swaying(100), [50], 2, 8)).nonzero().tolist() == [[50, 2]]
    assert not find_angle_spikes(turned(shaken(swaying(100), 4 * DEGREE), [50], 2, 8)).any()


@pytest.mark.parametrize("fps", [30, 60, 120])
def test_a_fast_swing_and_its_turning_point_are_no_spikes(fps):
    """A kick: 100 degrees there and back in half a second."""
    time = torch.arange(3 * fps, dtype=torch.float64) / fps
    angle = 100 * DEGREE * torch.exp(-0.5 * ((time - 1.5) / 0.1).square())
    quats = quat_xyzw(torch.stack([angle, 0 * angle, 0 * angle], dim=-1)[:, None])
    assert not find_angle_spikes(quats).any()
    assert not find_angle_spikes(shaken(quats, DEGREE)).any()


def test_leaps_of_a_place_are_found_and_a_sprint_is_not():
    time = torch.arange(120, dtype=torch.float64) / 30
    place = torch.stack([8 * time, 0.9 + 0 * time, 0 * time], dim=-1)
    assert not find_position_spikes(place).any()
    place[[30, 70, 71]] += torch.tensor([0.0, 1.5, 0.0])
    assert find_position_spikes(place).nonzero()[:, 0].tolist() == [30, 70, 71]
    noise = 0.5 * torch.randn(place.shape, generator=generator(3), dtype=torch.float64)
    assert not find_position_spikes(place.double() + noise).any()  # as large as this noise is


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5])
def test_short_recordings_do_not_break_it(frames):
    quats = swaying(frames)
    assert find_angle_spikes(quats).shape == (frames, 6)
    assert find_position_spikes(torch.zeros(frames, 3, dtype=torch.float64)).shape == (frames,)


@pytest.mark.parametrize("end", [0, -1])
def test_a_joint_that_swings_through_an_outermost_frame_does_not_spike_there(end):
    """A knee that swings by 25 degrees between the first two frames of a run, and ever less later."""
    angle = (-torch.arange(40, dtype=torch.float64) / 2).exp()[:, None, None] * torch.tensor([math.radians(65), 0, 0])
    swing = angle if end == 0 else angle.flip(0)
    assert not find_angle_spikes(quat_xyzw(swing))[end].any()
    swing[end] += torch.tensor([0.0, math.radians(90), 0.0])
    assert find_angle_spikes(quat_xyzw(swing))[end].all()
