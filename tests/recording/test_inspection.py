"""A recording is inspected: what leaps, what is held, what is a gap; fast swings and rests are none of it."""

import math
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from captures import DEGREE, apart_deg, on_rig, shaken, swaying, trembling
from helpers import generator, quat_xyzw

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.recording import inspection
from mapctl.recording.inspection import find_gaps, inspect_recording, travel
from mapctl.recording.masks import ALL, ROOT, Mask


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


def turned(quats, frames, joint, degrees):
    """A joint turned away in some frames."""
    vector = torch.zeros(len(frames), 3, dtype=torch.float64)
    vector[:, 1] = degrees * DEGREE
    out = quats.clone()
    out[frames, joint] = rotations.multiply(quats[frames, joint], rotations.from_rotation_vector(vector))
    return out


def find_angle_spikes(quats):
    return inspection.find_angle_spikes(quats, torch.ones(quats.shape[:2], dtype=torch.bool))


def find_position_spikes(positions):
    return inspection.find_position_spikes(positions, torch.ones(len(positions), dtype=torch.bool))


@pytest.mark.parametrize("frames", [[40], [40, 41], [2], [97], [0], [99]], ids=str)
@pytest.mark.parametrize("sigma", [0.0, 1.0, 4.0])
def test_planted_spikes_are_found_and_nothing_else_is(frames, sigma):
    quats = turned(shaken(swaying(100), sigma * DEGREE), frames, 3, 60)
    found = find_angle_spikes(quats)
    wanted = torch.zeros_like(found)
    wanted[frames, 3] = True
    assert torch.equal(found, wanted)


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
    position = torch.stack([8 * time, 0.9 + 0 * time, 0 * time], dim=-1)
    assert not find_position_spikes(position).any()
    position[[30, 70, 71]] += torch.tensor([0.0, 1.5, 0.0])
    assert find_position_spikes(position).nonzero()[:, 0].tolist() == [30, 70, 71]
    noise = 0.5 * torch.randn(position.shape, generator=generator(3), dtype=torch.float64)
    assert not find_position_spikes(position.double() + noise).any()  # as large as this noise is


@pytest.mark.parametrize("end", [0, -1])
def test_a_joint_that_swings_through_an_outermost_frame_does_not_spike_there(end):
    """A knee that swings by 25 degrees between the first two frames of a run, and ever less later."""
    angle = (-torch.arange(40, dtype=torch.float64) / 2).exp()[:, None, None] * torch.tensor([math.radians(65), 0, 0])
    swing = angle if end == 0 else angle.flip(0)
    assert not find_angle_spikes(quat_xyzw(swing))[end].any()
    swing[end] += torch.tensor([0.0, math.radians(90), 0.0])
    assert find_angle_spikes(quat_xyzw(swing))[end].all()


RIGS = ("canonical", "bandai", "daz")


def frozen(motion, start, stop):
    """Frames start to stop repeat the one before them."""
    frame = torch.arange(motion.num_frames)
    frame[start:stop] = start - 1
    return motion.pick(frame)


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("fps", [30, 120])
def test_a_body_that_freezes_and_goes_on_elsewhere_has_a_gap_there(rig, fps):
    motion = frozen(on_rig(rig, 3 * fps, fps=fps), fps, 2 * fps)
    assert find_gaps(motion) == (Mask(ALL, fps, 2 * fps),)


@pytest.mark.parametrize("rig", RIGS)
def test_a_leap_of_a_joint_is_found(rig):
    motion = on_rig(rig, 90)
    joint, quats = 7, motion.local_quat_xyzw.clone()
    turn = quat_xyzw(torch.tensor([1.0, 0.3, 0.0], dtype=torch.float64))
    quats[44:46, joint] = rotations.multiply(quats[44:46, joint], turn.expand(2, 4))
    leapt = replace(motion, local_quat_xyzw=quats)
    assert apart_deg(leapt.local_quat_xyzw, motion.local_quat_xyzw).max() > 50
    found = find_gaps(leapt)
    assert {mask.joint for mask in found} == {motion.skeleton.names[joint]}
    assert {frame for mask in found for frame in range(mask.start, mask.stop)} >= {44, 45}


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize(
    "spoil",
    [
        lambda motion: motion,
        lambda motion: frozen(motion, 60, 90),  # at rest, when the recording ends
        lambda motion: frozen(motion, 1, 90),  # a stand
    ],
    ids=["whole", "rest", "stand"],
)
def test_where_nothing_is_wrong_one_is_asked_to_say_what_is(rig, spoil):
    with pytest.raises(RequestError, match=r"give the missing frames \(--gap A:B\) or joints"):
        find_gaps(spoil(on_rig(rig, 90)))
