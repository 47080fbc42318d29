"""A recording is looked over: what stands still, what leaps, where its body is."""

from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from captures import DEGREE, apart_deg, on_rig, shaken, trembling

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.recording.inspection import inspect_recording, travel
from mapctl.recording.masks import ROOT, Mask


@pytest.fixture(scope="module", params=["canonical", "bandai", "daz"])
def motion(request):
    return on_rig(request.param, 120)


def moving_joint(motion):
    return next(j for j in range(5, motion.num_joints) if apart_deg(*motion.local_quat_xyzw[[0, 30], j]) > 1)


def with_quats(motion, frames, joint, quats):
    whole = motion.local_quat_xyzw.clone()
    whole[frames, joint] = quats
    return replace(motion, local_quat_xyzw=whole)


def test_a_joint_that_stands_still_is_found_and_only_that(motion):
    joint = moving_joint(motion)
    frozen = with_quats(motion, slice(40, 60), joint, motion.local_quat_xyzw[40, joint])
    found = inspect_recording(frozen)
    wanted = torch.zeros_like(found.dropouts)
    wanted[41:60, joint] = True  # frame 40 is the last that was true
    assert torch.equal(found.dropouts, wanted)
    assert torch.equal(found.seen, ~wanted)
    assert not found.spikes.any()


def test_what_no_longer_trembles_with_the_rest_is_found_to_the_end(motion):
    joint, noisy = moving_joint(motion), trembling(motion, 2 * DEGREE)
    found = inspect_recording(with_quats(noisy, slice(100, 120), joint, noisy.local_quat_xyzw[100, joint]))
    assert found.dropouts.nonzero().tolist() == [[frame, joint] for frame in range(101, 120)]


@pytest.mark.parametrize("whole", [False, True])
def test_what_comes_to_rest_and_leaves_it_again_is_no_loss(whole):
    """A joint, or the whole body, slows down, stands perfectly still for a second, and speeds up."""
    frames, skeleton = torch.arange(180, dtype=torch.float64), on_rig("canonical", 8).skeleton
    ramp = (((frames - 90).abs() - 15) / 30).clamp(0, 1)
    time = (ramp.square() * (3 - 2 * ramp)).cumsum(0) / 30
    phase = torch.linspace(0, 20, skeleton.num_joints * 3, dtype=torch.float64).reshape(-1, 3)
    own = time if whole else frames / 30
    angles = 0.4 * torch.sin(4 * own[:, None, None] + phase)
    angles[:, 5] = 0.4 * torch.sin(4 * time[:, None] + phase[5])
    root = own[:, None] * torch.tensor([0.1, 0.0, 1.0], dtype=torch.float64)
    rested = Motion(skeleton, Fraction(30), root, rotations.from_rotation_vector(angles))
    assert (rested.local_quat_xyzw[80:100, 5] == rested.local_quat_xyzw[90, 5]).all()
    found = inspect_recording(rested)
    assert found.seen.all()
    assert found.seen_root.all()


def test_a_clean_recording_is_believed(motion):
    found = inspect_recording(motion)
    assert found.seen.all()
    assert found.seen_root.all()
    assert torch.rad2deg(found.noise).max() < 0.1
    assert found.noise_root < 0.001


def test_noise_spikes_and_masks_come_together(motion):
    joint = moving_joint(motion)
    quats = shaken(motion.local_quat_xyzw, 2 * DEGREE)
    quats[70, joint] = rotations.multiply(quats[70, joint], torch.tensor([0.6, 0.0, 0.0, 0.8], dtype=torch.float64))
    name = motion.skeleton.names[moving_joint(motion)]
    found = inspect_recording(replace(motion, local_quat_xyzw=quats), [Mask(name, 10, 20), Mask(ROOT, 5, 6)])
    assert found.spikes.nonzero().tolist() == [[70, joint]]
    assert found.dropouts.nonzero().tolist() == [[frame, joint] for frame in range(10, 20)]
    assert found.dropouts_root.nonzero().tolist() == [[5]]
    assert torch.rad2deg(found.noise).tolist() == pytest.approx([2.0] * motion.num_joints, rel=0.45)
    assert not found.seen[70, joint]
    assert not found.seen[10:20, joint].any()


def test_gaps_are_filled_between_the_frames_around_them(motion):
    joint = moving_joint(motion)
    name = motion.skeleton.names[joint]
    wild = with_quats(motion, slice(50, 54), joint, shaken(motion.local_quat_xyzw, 2.0)[50:54, joint])
    repaired = inspect_recording(wild, [Mask(name, 50, 54)]).repaired()
    away = apart_deg(repaired.local_quat_xyzw, motion.local_quat_xyzw)
    start, stop = motion.local_quat_xyzw[[49, 54], joint]
    assert away[50:54, joint].max() < apart_deg(start, stop) + 3
    middle = rotations.slerp(start, stop, torch.tensor(0.4, dtype=torch.float64))
    assert apart_deg(middle, repaired.local_quat_xyzw[51, joint]) < 1
    away[50:54, joint] = 0
    assert away.max() < 1e-5
    assert torch.allclose(repaired.local_quat_xyzw.norm(dim=-1), torch.ones(1, dtype=torch.float64))


def test_the_place_below_a_static_root_is_judged_and_repaired():
    motion = on_rig("bandai", 120)
    hips = motion.moving_offsets[1].clone()
    hips[60] += torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64)
    hips[80:84] = 9.0
    found = inspect_recording(replace(motion, moving_offsets={**motion.moving_offsets, 1: hips}), [Mask(ROOT, 80, 84)])
    assert found.spikes_root.nonzero().tolist() == [[60]]
    repaired = found.repaired()
    assert (travel(repaired) - motion.moving_offsets[1]).norm(dim=-1).max() < 0.02
    assert torch.equal(repaired.root_position, motion.root_position)


@pytest.mark.parametrize("frames", [1, 2, 3, 6])
def test_short_recordings_break_nothing(frames):
    motion = on_rig("canonical", 30).slice(0, frames)
    found = inspect_recording(motion)
    assert found.seen.shape == (frames, motion.num_joints)
    assert found.repaired().num_frames == frames
