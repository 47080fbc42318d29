"""Guesses at what is not known: straight and short ways, that nothing unknown has a part in."""

import pytest
import torch
from helpers import moved, walk

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
