"""Motion: slices, joins, other frame rates, mirror images."""

import math
from fractions import Fraction

import pytest
import torch
from helpers import bandai_skeleton, generator, random_motion, turn_between

from mapctl.errors import MapctlError, RequestError
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton


def travelling(frames=6, seed=0):
    """A motion whose joint 1 travels within its parent."""
    motion = random_motion(bandai_skeleton(), frames, seed=seed)
    track = torch.randn(frames, 3, generator=generator(seed), dtype=torch.float64)
    return Motion(motion.skeleton, motion.fps, motion.root_position, motion.local_quat_xyzw, {1: track}, "layout")


def same(a, b, tolerance=1e-9):
    torch.testing.assert_close(a.joint_positions(), b.joint_positions(), atol=tolerance, rtol=0)
    assert turn_between(a.joint_rotations(), b.joint_rotations()) < 1e-6


def test_parts_joined_are_the_whole():
    motion = travelling()
    whole = motion.slice(0, 2).join(motion.slice(2, 6))
    same(whole, motion)
    assert whole.source == motion.source == "layout"
    assert (whole.num_frames, whole.num_joints, whole.seconds) == (6, 22, 0.2)


@pytest.mark.parametrize("other", ["fps", "skeleton"])
def test_unlike_motions_are_not_joined(other):
    motion = random_motion(CANONICAL, 3)
    fps = Fraction(60) if other == "fps" else Fraction(30)
    longer = Skeleton(CANONICAL.names, CANONICAL.parents, CANONICAL.offsets * (1.1 if other == "skeleton" else 1))
    with pytest.raises(MapctlError, match="one skeleton and frame rate"):
        motion.join(random_motion(longer, 3, fps=fps))


def test_twice_the_rate_keeps_every_frame_and_puts_one_midway():
    motion = travelling()
    fine = motion.resample(60)
    assert (fine.num_frames, fine.fps) == (11, Fraction(60))
    torch.testing.assert_close(fine.root_position[::2], motion.root_position)
    torch.testing.assert_close(fine.moving_offsets[1][::2], motion.moving_offsets[1])
    assert turn_between(fine.local_quat_xyzw[::2], motion.local_quat_xyzw) < 1e-6
    middle = (motion.root_position[:-1] + motion.root_position[1:]) / 2
    torch.testing.assert_close(fine.root_position[1::2], middle)
    left = turn_between(fine.local_quat_xyzw[1], fine.local_quat_xyzw[0])
    right = turn_between(fine.local_quat_xyzw[1], fine.local_quat_xyzw[2])
    assert left == pytest.approx(right, abs=1e-6)
    same(fine.resample(30), motion)


@pytest.mark.parametrize("fps", [0, -30, 1e-9, math.nan, math.inf, 1e12, "30"])
def test_rates_that_cannot_be_are_refused(fps):
    with pytest.raises(RequestError, match="frame rate"):
        Motion.resample.__wrapped__(travelling(), fps)


def test_poses_between_frames_and_beyond_the_ends():
    motion = travelling()
    found = motion.sample(torch.tensor([-3.0, 0.0, 1.5, 99.0], dtype=torch.float64))
    same(found.slice(0, 2), motion.pick(torch.tensor([0, 0])))
    same(found.slice(3, 4), motion.slice(motion.num_frames - 1, motion.num_frames))
    torch.testing.assert_close(found.root_position[2], motion.root_position[1:3].mean(0))


def test_a_mirror_image_has_every_joint_on_the_other_side():
    bones = CANONICAL.offsets * (1 + 0.2 * torch.rand(21, 1, generator=generator(), dtype=torch.float64))
    motion = random_motion(Skeleton(CANONICAL.names, CANONICAL.parents, bones))
    image = motion.mirror()
    for name, other in (("hips", "hips"), ("head", "head"), ("leftHand", "rightHand"), ("rightToes", "leftToes")):
        position = motion.joint_positions()[:, CANONICAL.index(name)] * torch.tensor([-1.0, 1, 1])
        torch.testing.assert_close(image.joint_positions()[:, CANONICAL.index(other)], position, atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", ["Toes_R", "Hand_L", "mixamorig:LeftUpLeg", "Bip01 R Thigh", "footleft"])
def test_sides_named_otherwise_are_not_mirrored_in_silence(name):
    rig = Skeleton(("hips", "leftHand", "rightHand", name), (-1, 0, 0, 0), torch.zeros(4, 3).double())
    with pytest.raises(MapctlError, match=f"cannot tell left from right by the joints {name}; use retarget"):
        random_motion(rig).mirror()
