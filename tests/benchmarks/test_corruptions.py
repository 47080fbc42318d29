"""Clean captures spoilt in known ways: what the table of denoising is measured on."""

import math

import pytest
import torch
from captures import apart_deg, error_cm, on_rig
from helpers import generator

from controllers.benchmarks.shared.corruptions import (
    CONDITIONS,
    add_drift,
    add_lasting_noise,
    add_noise,
    detect_true_contacts,
    drop_arm,
    filter_noisy,
    perturb_positions,
)
from mapctl import rotations
from mapctl.recording.masks import expand_valid_masks


@pytest.fixture(scope="module", params=["canonical", "bandai", "daz"])
def motion(request):
    return on_rig(request.param, 150)


@pytest.mark.parametrize("name", CONDITIONS)
def test_every_condition_keeps_rig_frames_and_rate_and_is_seeded(motion, name):
    spoilt, again, other = (CONDITIONS[name](motion, generator(seed)) for seed in (1, 1, 2))
    assert spoilt.motion.skeleton is motion.skeleton
    assert (spoilt.motion.num_frames, spoilt.motion.fps) == (motion.num_frames, motion.fps)
    assert set(spoilt.motion.moving_offsets) == set(motion.moving_offsets)
    assert torch.equal(spoilt.motion.local_quat_xyzw, again.motion.local_quat_xyzw)
    assert torch.equal(spoilt.motion.joint_positions(), again.motion.joint_positions())
    assert spoilt.masks == again.masks
    assert not torch.equal(spoilt.motion.local_quat_xyzw, other.motion.local_quat_xyzw)
    assert error_cm(motion, spoilt.motion) > 0.3


@pytest.mark.parametrize("name", CONDITIONS)
def test_masks_fit_the_recording(motion, name):
    spoilt = CONDITIONS[name](motion, generator(1))
    joints, root = expand_valid_masks(spoilt.motion, spoilt.masks)  # refuses what does not fit
    assert not root.any()
    if "lost" not in name:
        assert not spoilt.masks
        return
    away = apart_deg(motion.local_quat_xyzw, spoilt.motion.local_quat_xyzw)
    assert away[joints].mean() > 30  # whoever looks at it sees it
    assert away[~joints].max() < 10


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_as_many_joints_are_lost_as_the_condition_says(motion, share):
    spoilt = CONDITIONS[f"{100 * share:g} % of joints lost"](motion, generator(1))
    assert float(expand_valid_masks(motion, spoilt.masks)[0].double().mean()) == pytest.approx(share, rel=0.1)


def test_noise_is_that_which_was_asked_for(motion):
    spoilt = add_noise(motion, generator(), degrees=3.0, centimetres=1.5, spikes=0.0).motion
    moves = (motion.local_quat_xyzw != motion.local_quat_xyzw[:1]).any(dim=-1).any(dim=0)
    away = apart_deg(motion.local_quat_xyzw, spoilt.local_quat_xyzw)
    assert float((away[:, moves].square().mean() / 3).sqrt()) == pytest.approx(3, rel=0.03)
    assert (away[:, ~moves] < 1e-5).all()
    hips = 1 if motion.moving_offsets else 0
    apart = spoilt.joint_positions()[:, hips] - motion.joint_positions()[:, hips]
    assert 100 * float(apart.square().mean().sqrt()) == pytest.approx(1.5, rel=0.1)


def turned(before, after) -> torch.Tensor:
    return rotations.to_rotation_vector(rotations.multiply(rotations.inverse(before), after))


def test_noise_lasts_as_long_as_was_asked_for(motion):
    spoilt = add_lasting_noise(motion, generator(), degrees=3.0, centimetres=1.5, seconds=0.1).motion
    moves = (motion.local_quat_xyzw != motion.local_quat_xyzw[:1]).any(dim=-1).any(dim=0)
    noise = torch.rad2deg(turned(motion.local_quat_xyzw, spoilt.local_quat_xyzw))[:, moves]
    assert float(noise.square().mean().sqrt()) == pytest.approx(3, rel=0.1)
    for frames in (1, 3):
        kept = (noise[frames:] * noise[:-frames]).mean() / noise.square().mean()
        assert float(kept) == pytest.approx(math.exp(-frames / 3), abs=0.1)
    hips = 1 if motion.moving_offsets else 0
    apart = spoilt.joint_positions()[:, hips] - motion.joint_positions()[:, hips]
    assert 100 * float(apart.square().mean().sqrt()) == pytest.approx(1.5, rel=0.35)


def test_a_capture_that_was_filtered_holds_what_is_slow_alone(motion):
    spoilt = filter_noisy(motion, generator(), degrees=5.0, centimetres=2.0, hertz=6.0).motion
    noise = turned(motion.local_quat_xyzw, spoilt.local_quat_xyzw)
    power = torch.fft.rfft(noise, dim=0).abs().square().sum(dim=(1, 2))
    assert float(power[60:].sum() / power.sum()) < 0.02  # from 12 Hz on
    assert float(power[5:25].sum() / power.sum()) > 0.5


def test_misplaced_joints_keep_their_bones(motion):
    spoilt = perturb_positions(motion, generator(), centimetres=5.0).motion
    parents = list(motion.skeleton.parents)

    def bones(one):
        places = one.joint_positions()
        below = [j for j, parent in enumerate(parents) if parent >= 0 and j not in one.moving_offsets]
        return (places[:, below] - places[:, [parents[j] for j in below]]).norm(dim=-1)

    assert torch.allclose(bones(spoilt), bones(motion), atol=1e-6)
    assert 3 < error_cm(motion, spoilt) < 30


def test_a_lost_arm_is_lost_in_the_middle(motion):
    masks = drop_arm(motion, generator(), seconds=2.0).masks
    assert len(masks) == 3
    assert {(mask.start, mask.stop) for mask in masks} == {(45, 105)}


def test_a_drifting_body_takes_its_feet_along(motion):
    spoilt = add_drift(motion, generator(), speed=0.2).motion
    drift = (spoilt.joint_positions() - motion.joint_positions()).mean(dim=1)[:, 0]
    smooth = drift.unfold(0, 9, 1).mean(dim=-1)
    assert 0.1 < 30 * torch.diff(smooth).abs().max() < 0.35
    assert drift.abs().max() < 0.15


def test_true_contacts_are_of_both_feet_in_turn(motion):
    contacts = detect_true_contacts(motion)
    assert contacts.shape == (150, 2)
    assert (contacts.double().mean(dim=0) > 0.05).all()
    assert not contacts.all(dim=0).any()
