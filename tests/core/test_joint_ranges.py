"""Ranges of joints: what their table says, that angles and rotations are one, and who is beyond."""

import json
import math
from dataclasses import replace
from importlib.resources import files

import pytest
import torch
from helpers import generator, walk_through

from mapctl import joint_ranges, rotations
from mapctl.skeleton import CANONICAL, LIMBS

OTHERS = CANONICAL.num_joints - 1
TABLE = json.loads(files("mapctl.joint_ranges").joinpath(joint_ranges.TABLE).read_text("utf-8"))


def free_numbers(*shape, spread=2.0):
    return spread * torch.randn(*shape, OTHERS, 3, generator=generator(), dtype=torch.float64)


def test_any_numbers_become_angles_within_the_ranges_and_come_near_both_ends():
    ranges = joint_ranges.load()
    angles = ranges.constrain(free_numbers(500, spread=1e3))
    assert float(ranges.find_excess(angles).max()) < 1e-12
    torch.testing.assert_close(angles.amin(dim=0), ranges.low)
    torch.testing.assert_close(angles.amax(dim=0), ranges.high)
    torch.testing.assert_close(ranges.constrain(torch.zeros(OTHERS, 3).double()), (ranges.low + ranges.high) / 2)


def test_right_is_the_mirror_image_of_left():
    ranges, partners = joint_ranges.load(), CANONICAL.mirror_partners()
    angles = ranges.constrain(free_numbers(50))
    hips = torch.eye(3).double().expand(50, 1, 3, 3)
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    mirrored = (torch.cat([hips, ranges.to_matrices(angles)], dim=1)[:, partners] * flip[:, None] * flip)[:, 1:]
    assert float(ranges.find_excess(ranges.to_angles(mirrored)).max()) < 0.02


def calm():
    """Legs that swing, and nothing else."""
    return walk_through(torch.zeros(30, 2), swing=0.3)


def test_a_joint_beyond_its_limit_is_named_with_frame_and_degrees():
    motion = calm()
    quats = motion.local_quat_xyzw.clone()
    knee = LIMBS["leftFoot"].lower
    for frame, degrees in ((4, -25.0), (9, -40.0)):
        quats[frame, knee] = rotations.from_rotation_vector(
            torch.tensor([math.radians(degrees), 0, 0], dtype=torch.float64)
        )
    (found,) = joint_ranges.outside(replace(motion, local_quat_xyzw=quats))
    assert (found.joint, found.frame) == ("leftLowerLeg", 9)
    assert found.degrees == pytest.approx(40 - 10, abs=0.01)
