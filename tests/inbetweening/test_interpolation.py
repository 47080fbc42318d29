"""Guesses at what is not known: straight and short ways, that nothing unknown has a part in."""

import pytest
import torch
from helpers import generator, moved, walk
from hypothesis import given, settings
from hypothesis import strategies as st

from mapctl import kinematics
from mapctl.inbetweening.interpolation import interpolate_heading, interpolate_positions
from mapctl.skeleton import CANONICAL

FRAMES = 40


def with_hole(start, stop):
    known = torch.ones(1, FRAMES, CANONICAL.num_joints, dtype=torch.bool)
    known[:, start:stop] = False
    return known


def guess(motion, known):
    return interpolate_positions(motion.joint_positions()[None], motion.local_quat_xyzw[None], known)


@settings(max_examples=10)
@given(st.integers(0, 1000), st.sampled_from([0.05, 0.3, 0.9]))
def test_what_is_not_known_has_no_part_in_it(seed, share):
    motion, draw = walk(FRAMES, turn_rate=2.0), generator(seed)
    known = (torch.rand(1, FRAMES, 1, generator=draw) < share).expand(-1, -1, CANONICAL.num_joints).clone()
    known[:, 4 + seed % 30] = True
    places, quats = motion.joint_positions()[None], motion.local_quat_xyzw[None]
    facing = kinematics.heading(quats[..., 0, :])
    wild = torch.nn.functional.normalize(torch.randn(quats.shape, generator=draw).double(), dim=-1)
    other = torch.where(known[..., None], quats, wild)
    elsewhere = torch.where(known[..., None], places, 9 * torch.randn(places.shape, generator=draw).double())
    assert torch.equal(interpolate_positions(places, quats, known), interpolate_positions(elsewhere, other, known))
    turned = torch.where(known[..., 0], facing, 9 * torch.randn(facing.shape, generator=draw).double())
    assert torch.equal(interpolate_heading(facing, known), interpolate_heading(turned, known))


def test_known_places_stay():
    motion, known = walk(FRAMES), with_hole(10, 20)
    assert torch.equal(guess(motion, known)[known], motion.joint_positions()[None][known])


def test_the_hips_go_straight_across_a_gap_and_hold_beyond_the_last_known_frame():
    motion = walk(FRAMES, turn_rate=1.0)
    hips, whole = guess(motion, with_hole(10, 20))[0, :, 0], motion.root_position
    weight = torch.arange(12).double()[:, None] / 11
    assert torch.allclose(hips[9:21], (1 - weight) * whole[9] + weight * whole[20], atol=1e-12)
    held = guess(motion, with_hole(30, FRAMES))[0, 29:]
    assert torch.allclose(held, held[:1].expand_as(held), atol=1e-9)


@pytest.mark.parametrize("facing", [-3.0, 0.0, 1.5, 3.0])
def test_across_a_gap_the_heading_takes_the_short_way(facing):
    """Through a half turn too."""
    motion = moved(walk(FRAMES, turn_rate=0.5), turn=facing, shift=(0.0, 0.0))
    found = interpolate_heading(kinematics.heading(motion.local_quat_xyzw[:, 0])[None], with_hole(10, 30))
    assert torch.diff(found[0]).abs().max() < 0.03
