"""Captures: what was not seen is filled in, and shows nothing of itself."""

import math

import pytest
import torch
from captures import shaken
from helpers import quat_xyzw, walk
from hypothesis import strategies as st

from mapctl import rotations
from mapctl.recording import Capture
from mapctl.skeleton import CANONICAL

masks = st.lists(st.lists(st.booleans(), min_size=9, max_size=9), min_size=1, max_size=3).map(torch.tensor)


def capture_of(motion, seen=None, seen_root=None):
    everything = torch.ones(motion.num_frames, motion.num_joints, dtype=torch.bool)
    return Capture.of_motion(
        motion,
        seen=everything if seen is None else seen,
        seen_root=everything[:, 0] if seen_root is None else seen_root,
        sigma=torch.zeros(motion.num_joints),
        sigma_root=0.0,
    )


def test_rotation_vectors_near_a_half_turn_stay_continuous_and_mean_the_same():
    """A joint that sways about 180 degrees: its short rotation vector would jump from one end to the other."""
    motion = walk(60)
    quats = motion.local_quat_xyzw.clone()
    angle = math.pi + 0.5 * torch.sin(torch.arange(60, dtype=torch.float64) / 6)
    quats[:, 5] = quat_xyzw(angle[:, None] * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64))
    quats = rotations.make_sign_continuous(quats)
    capture = capture_of(type(motion)(motion.skeleton, motion.fps, motion.root_position, quats))
    assert torch.diff(capture.joints[0, :, 4], dim=0).norm(dim=-1).max() < 0.2
    back = rotations.from_rotation_vector(capture.joints[0].double())
    assert ((back * quats[:, 1:]).sum(-1).abs() > 1 - 1e-6).all()


def test_heading_and_tilt_make_the_hips():
    capture = capture_of(walk(80, turn_rate=2.5))
    tilt = torch.stack([capture.tilt[..., 0], 0 * capture.heading, capture.tilt[..., 1]], dim=-1)
    again = rotations.multiply(rotations.about_y(capture.heading), rotations.from_rotation_vector(tilt))
    assert ((again * capture.hips).sum(-1).abs() > 1 - 1e-5).all()
    assert capture.heading[0, -1] > 2 * math.pi  # whole turns are counted


@pytest.mark.parametrize("lost", [(20, 30), (0, 4), (55, 60)])
def test_what_unseen_frames_show_does_not_matter_to_heading_and_tilt(lost):
    motion = walk(60, turn_rate=2.0)
    seen = torch.ones(60, CANONICAL.num_joints, dtype=torch.bool)
    seen[lost[0] : lost[1], 0] = False
    whole, shown = capture_of(motion, seen), []
    for seed in (1, 2):
        wild = shaken(motion.local_quat_xyzw, 3.0, seed=seed)
        quats = torch.where(seen[..., None], motion.local_quat_xyzw, wild)
        shown.append(capture_of(type(motion)(motion.skeleton, motion.fps, motion.root_position, quats), seen))
    for capture in shown:
        assert torch.allclose(capture.heading, whole.heading, atol=1e-5)
        assert torch.allclose(capture.tilt, whole.tilt, atol=1e-5)
    truth = capture_of(motion).heading
    assert (whole.heading - truth).abs().max() < 0.5  # filled in, no turn lost
