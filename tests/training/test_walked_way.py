"""The way between two keys: it bends for who walks, and for nobody else."""

import math

import pytest
import torch

from mapctl import rotations
from priors import tweener

FRAMES = 193


def bend_trajectory(way, facing, given):
    return tweener.bend_trajectory(way, facing, placed=given, faced=given)


def lead(displacement, first, last, frames=FRAMES, turn=0.0):
    """Straight from the origin, evenly turning, between two keys; all of it turned; degrees."""
    share = torch.linspace(0, 1, frames).double()[None]
    headings = torch.deg2rad(first + (last - first) * share) + turn
    end = rotations.rotate_ground(torch.tensor(displacement).double(), torch.tensor(turn).double())
    given = torch.zeros(1, frames, dtype=torch.bool)
    given[:, [0, -1]] = True
    return share[..., None] * end, headings, given


def test_a_corner_is_left_along_one_heading_and_entered_along_the_other():
    way, facing = bend_trajectory(*lead((4.0, 4.0), 0.0, 90.0))
    degrees = torch.rad2deg(facing[0])
    assert degrees[:32].abs().max() < 15
    assert (degrees[-32:] - 90).abs().max() < 15
    assert degrees[FRAMES // 2] == pytest.approx(45, abs=1)
    assert bool((torch.diff(degrees) > -0.01).all())
    steps = torch.diff(way[0], dim=0)
    assert torch.allclose(steps.norm(dim=-1), steps.norm(dim=-1).mean().expand(FRAMES - 1), rtol=0.03)
    along = torch.atan2(steps[:, 0], steps[:, 1])
    middle = (facing[0, 1:] + facing[0, :-1]) / 2
    assert rotations.wrap_angle(along - middle).abs().max() < math.radians(2)


@pytest.mark.parametrize(
    ("displacement", "first", "last", "frames"),
    [
        ((0.5, 0.5), 0.0, 90.0, FRAMES),  # who turns on the spot
        ((4.0, 4.0), 180.0, 225.0, FRAMES),  # who walks backwards
        ((4.0, 0.0), 0.0, 0.0, FRAMES),  # and sideways
        ((0.7, 0.7), 0.0, 90.0, 30),  # a second
    ],
)
def test_the_route_stays_straight_for_sidesteps_or_without_time(displacement, first, last, frames):
    way, facing, given = lead(displacement, first, last, frames)
    bent, turned = bend_trajectory(way, facing, given)
    assert torch.equal(bent, way)
    assert torch.equal(turned, facing)


def test_given_frames_stay_and_a_turned_trajectory_gives_the_same_motion():
    way, facing, given = lead((3.0, 5.0), -10.0, 60.0)
    bent, turned = bend_trajectory(way, facing, given)
    assert torch.equal(bent[given], way[given])
    assert torch.equal(turned[given], facing[given])
    assert (bent - way).norm(dim=-1).max() > 0.1
    for turn in (1.0, 3.0, -2.5):
        other, facing_other = bend_trajectory(*lead((3.0, 5.0), -10.0, 60.0, turn=turn))
        wanted = rotations.rotate_ground(bent, torch.tensor(turn).double().expand(1, FRAMES))
        assert torch.allclose(other, wanted, atol=1e-9)
        assert torch.allclose(facing_other, turned + turn, atol=1e-9)
