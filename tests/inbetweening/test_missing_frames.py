"""Missing frames and joints in queries at 30 fps, and their interpolation."""

import math
from dataclasses import replace

import pytest
import torch
from captures import apart_deg, on_rig
from helpers import generator, moved, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from linear_inbetweener import LinearInbetweener
from scipy.spatial.transform import Rotation, Slerp
from tiny_infiller import shown

from controllers.inbetweening.pipeline import CanonicalClip, fill
from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.inbetweening.partial_motion import KnownParts, PartialMotion, interpolate_partial_motion, mirror_quats
from mapctl.recording.masks import ALL, ROOT, Mask, MissingMask
from mapctl.skeleton import CANONICAL


def lost_of(motion, *masks):
    return MissingMask.of_masks(motion, masks, retarget.to_canonical(motion)[1])


def interpolated(quats, start, stop):
    """Between the frames beside a gap, by scipy; (gap, joints, 4)."""
    between = [
        Slerp([start - 1, stop], Rotation.from_quat(quats[[start - 1, stop], joint].numpy()))(
            range(start, stop)
        ).as_quat()
        for joint in range(quats.shape[1])
    ]
    return torch.stack([torch.from_numpy(quat) for quat in between], dim=1)


@pytest.mark.parametrize(("rig", "start", "stop"), [("canonical", 20, 40), ("bandai", 20, 21), ("daz", 1, 49)])
def test_a_gap_between_single_frames_is_crossed_by_slerp_and_straight_lines(rig, start, stop):
    motion = on_rig(rig, 50)
    lost = torch.ones(50, dtype=torch.bool)
    lost[[start - 1, stop]] = False
    result = interpolate_missing(motion, MissingMask.of_frames(lost, motion.num_joints))
    wanted = interpolated(motion.local_quat_xyzw, start, stop)
    assert apart_deg(result.local_quat_xyzw[start:stop], wanted).max() < 1e-5
    pairs = [(result.root_position, motion.root_position)]
    pairs += [(result.moving_offsets[joint], values) for joint, values in motion.moving_offsets.items()]
    weight = (torch.arange(start, stop).double() - (start - 1))[:, None] / (stop - start + 1)
    for found, ends in pairs:
        line = (1 - weight) * ends[start - 1] + weight * ends[stop]
        assert torch.allclose(found[start:stop], line, atol=1e-12)


def swung(seconds, fps):
    """A leap: the hips in a parabola, an arm that swings with constant acceleration."""
    time = torch.arange(round(seconds * fps)).double() / fps
    motion = walk(len(time), fps=fps)
    root, quats = torch.zeros(len(time), 3).double(), torch.zeros(len(time), motion.num_joints, 4).double()
    root[:, 1], quats[..., 3] = 1 + 3 * time - 4.9 * time**2, 1.0
    angle = 2 * time + 6 * time**2
    arm = motion.skeleton.index("leftUpperArm")
    quats[:, arm, 0], quats[:, arm, 3] = (angle / 2).sin(), (angle / 2).cos()
    return replace(motion, root_position=root, local_quat_xyzw=quats)


@pytest.mark.parametrize(("fps", "after", "left"), [(30, 1, 0.7), (120, 10, 0.35)])
def test_a_short_gap_goes_on_at_the_velocities_beside_it(fps, after, left):
    """Errors of slerp; with one frame after the gap only the velocity before it is known."""
    motion = swung(1.5, fps)
    start = stop = motion.num_frames // 3
    stop += round(0.2 * fps)
    motion = motion.slice(0, stop + after)
    truth, result = motion.joint_positions(), interpolate_missing(motion, lost_of(motion, Mask(ALL, start, stop)))
    lost = torch.ones(stop + after, dtype=torch.bool)
    lost[[start - 1, stop]] = False
    straight = interpolate_missing(motion, MissingMask.of_frames(lost, motion.num_joints))

    def error(found):
        return (found.joint_positions() - truth)[start:stop].norm(dim=-1).mean()

    assert error(result) < left * error(straight)
    seam = torch.diff(result.joint_positions()[start - 2 : start + 1], n=2, dim=0).norm(dim=-1).max()
    assert seam < 0.5 * torch.diff(straight.joint_positions()[start - 1 : start + 1], dim=0).norm(dim=-1).max()


def names_of(motion, lost):
    """Joints that are lost in any frame."""
    return {name for name, gone in zip(motion.skeleton.names, lost.joints.any(dim=0).tolist(), strict=True) if gone}


@pytest.mark.parametrize(
    ("joint", "taken"),
    [
        ("leftHand", {"leftHand", "leftLowerArm"}),
        ("leftLowerArm", {"leftLowerArm", "leftUpperArm"}),
        ("leftUpperArm", {"leftUpperArm", "leftShoulder"}),
        ("rightToes", {"rightToes", "rightFoot"}),
        ("head", {"head", "neck"}),
        # A shoulder's place is the chest's doing, which the neck and the other shoulder show.
        ("leftShoulder", {"leftShoulder"}),
        ("leftUpperLeg", {"leftUpperLeg"}),
        ("hips", {"hips"}),
    ],
)
def test_a_lost_place_takes_the_rotation_that_put_it_there_along(joint, taken):
    motion = on_rig("canonical", 30)
    lost = lost_of(motion, Mask(joint, 5, 9))
    assert names_of(motion, lost) == taken
    assert lost.joints[5:9].sum() == 4 * len(taken)
    assert lost.frames.nonzero()[:, 0].tolist() == [5, 6, 7, 8]
    assert not lost.root.any()


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ([Mask("leftHnad", 5, 9)], "no joint 'leftHnad'.* the nearest is leftHand"),
        ([Mask(ALL, 5, 31)], "ends at 31, the recording at 30"),
        ([Mask(ALL, 0, 30)], "leave nothing of the motion's 30 frames"),
        ([Mask(ALL, 0, 15), Mask(ALL, 15, 30)], "leave nothing"),
        ([Mask(ROOT, 0, 30)], "leave nothing"),
    ],
)
def test_what_cannot_be_is_refused(masks, message):
    with pytest.raises(RequestError, match=message):
        lost_of(on_rig("canonical", 30), *masks)


def keyed(motion, keys, *, hips=()):
    """All is lost but whole poses, and the hips alone in some frames."""
    free = torch.ones(motion.num_frames, dtype=torch.bool)
    free[list(keys)] = False
    joints, root = free[:, None].expand(-1, motion.num_joints).clone(), free.clone()
    joints[list(hips), 0] = False
    root[list(hips)] = False
    return MissingMask(joints, root)


def gap_of(motion, lost):
    """A canonical motion is shown as it is, whatever stands where it is lost."""
    clip = CanonicalClip.of(motion, lost)
    return replace(clip, canonical=motion).query()


def known(gap):
    """Moments of which nothing is lost."""
    return (~gap.missing.frames).nonzero()[:, 0].tolist()


@pytest.mark.parametrize(("fps", "spare"), [(10, 0), (24, 3), (50, 0), (120, 3)])
def test_times_are_even_up_to_the_end(fps, spare):
    motion = walk(fps + spare, fps=fps)
    gap = gap_of(motion, keyed(motion, (0, motion.num_frames - 1)))
    steps = torch.diff(gap.seconds)
    assert len(gap.seconds) == gap.motion.num_frames == len(gap.missing.joints) == len(gap.missing.root)
    assert steps[:-1].tolist() == pytest.approx([1 / 30] * (len(steps) - 1))
    assert 0.5 / 30 < steps[-1] < 1.001 / 30
    assert gap.seconds[0] == 0
    assert abs(float(gap.seconds[-1]) - (motion.num_frames - 1) / fps) < 0.501 / 30
    assert known(gap) == [0, gap.motion.num_frames - 1]


@pytest.mark.parametrize("fps", [10, 24, 50, 60, 120])
def test_a_key_at_any_frame_is_one_moment_with_the_pose_of_its_time(fps):
    """A network takes frames for 1/30 s apart: a pose of another time would be a hip that stops or hurries there."""
    motion = walk(fps, fps=fps, turn_rate=0.5)
    even = motion.resample(30)
    for key in range(2 * max(1, fps // 30), fps - 2 * max(1, fps // 30), 1 + fps // 4):
        gap = gap_of(motion, keyed(motion, (0, key, fps - 1)))
        _, moment, _ = known(gap)
        assert abs(float(gap.seconds[moment]) - key / fps) < 0.501 / 30
        assert torch.allclose(gap.motion.root_position[moment], even.root_position[moment], atol=1e-12)
        assert apart_deg(gap.motion.local_quat_xyzw[moment], even.local_quat_xyzw[moment]).max() < 1e-5
        assert not gap.missing.root[moment]
        assert gap.known_positions[moment].all()


@pytest.mark.parametrize(("fps", "key"), [(60, 31), (100, 52)])
def test_a_motion_passes_a_key_between_two_moments_without_a_jolt(fps, key):
    motion = walk(2 * fps, fps=fps)
    done = fill(motion, keyed(motion, (0, key, 2 * fps - 1)), LinearInbetweener(), refinement=None).motion
    found, wanted = (torch.diff(each.root_position, dim=0)[:, ::2].norm(dim=-1) for each in (done, motion))
    assert torch.equal(done.root_position[key], motion.root_position[key])
    assert torch.allclose(found[key - 6 : key + 6], wanted[key - 6 : key + 6], rtol=0.1)


@pytest.mark.parametrize("fps", [12, 15, 24, 30, 60, 120])
def test_a_note_names_the_frames_of_a_gap(fps):
    motion = walk(60, fps=fps)
    missing = MissingMask.of_frames((torch.arange(60) >= 11) & (torch.arange(60) < 31), motion.num_joints)
    (note,) = fill(motion, missing, LinearInbetweener(), refinement=None).gap_notes
    assert note.startswith("frames 11:31: ")


def test_a_place_is_known_only_with_all_that_carries_it():
    motion = walk(30)
    _, rigmap = retarget.to_canonical(motion)
    gap = gap_of(motion, MissingMask.of_masks(motion, [Mask(ROOT, 5, 9)], rigmap))
    assert not gap.known_positions[5:9].any()
    assert gap.known_positions[9:].all()
    gap = gap_of(motion, MissingMask.of_masks(motion, [Mask("chest", 5, 9)], rigmap))
    unknown = {CANONICAL.names[joint] for joint in (~gap.known_positions[6]).nonzero()[:, 0].tolist()}
    assert {"head", "leftHand", "neck"} <= unknown
    assert not unknown & {"hips", "leftFoot", "rightToes"}


FRAMES = 40
MEAN = torch.nn.functional.normalize(
    torch.randn(CANONICAL.num_joints, 4, generator=torch.Generator().manual_seed(5)), dim=-1
)


def partial_motion(known, seed=0):
    """A made motion, facing anywhere, and numbers that mean nothing where it is not known."""
    motion = on_rig("canonical", FRAMES)
    heading, tilt = rotations.split_heading(motion.local_quat_xyzw[:, 0])
    quats = torch.cat([tilt[:, None], motion.local_quat_xyzw[:, 1:]], dim=1)[None]
    garbage = torch.nn.functional.normalize(
        torch.randn(quats.shape, generator=torch.Generator().manual_seed(seed)).double(), dim=-1
    )
    quats = torch.where(known.rotations[..., None], quats, garbage)
    root = torch.where(known.root[..., None], motion.root_position[None], 9.0 + seed)
    heading = torch.where(known.heading, rotations.unwrap_angle(heading)[None], 50.0 * seed)
    offsets = CANONICAL.offsets[None]
    return PartialMotion(root, heading, quats, torch.full((1, FRAMES, 2), 0.5), offsets, known)


def world_positions(motion):
    return motion.world_poses()[0]


def gap(start=10, stop=25):
    known = torch.ones(1, FRAMES, dtype=torch.bool)
    known[:, start:stop] = False
    return KnownParts.whole(known)


def test_unknown_values_do_not_matter_and_known_ones_stay():
    one, other = (interpolate_partial_motion(partial_motion(gap(), seed), MEAN, 0.9) for seed in (1, 2))
    torch.testing.assert_close(world_positions(one), world_positions(other), atol=1e-9, rtol=0)
    known = partial_motion(gap()).known.positions
    truth = on_rig("canonical", FRAMES).joint_positions()[None]
    torch.testing.assert_close(world_positions(one)[known], truth[known], atol=1e-9, rtol=0)


def test_a_mirrored_motion_has_mirrored_places():
    motion = partial_motion(KnownParts.whole(torch.ones(1, FRAMES, dtype=torch.bool)))
    flipped = world_positions(motion)[..., CANONICAL.mirror_partners(), :] * torch.tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(world_positions(motion.mirrored()), flipped, atol=1e-9, rtol=0)
    torch.testing.assert_close(mirror_quats(mirror_quats(motion.quats)), motion.quats)


def drawn_masks(seed, share):
    """Numbers of frames and of joints."""
    draw = generator(seed)
    whole = torch.rand(1, FRAMES, 1, generator=draw) < share
    known = whole & (torch.rand(1, FRAMES, CANONICAL.num_joints, generator=draw) < 0.8)
    known[:, 4 + seed % 30, 0] = True  # without any known root there is no place to see the rest from
    return known


masks = st.builds(drawn_masks, st.integers(0, 1000), st.sampled_from([0.05, 0.3, 0.9]))


@settings(max_examples=10)
@given(masks)
def test_known_places_come_back_and_the_way_back_is_the_way_there(known):
    motion = walk(FRAMES, turn_rate=2.0)
    image, wanted = shown(motion, known), motion.joint_positions()[None]
    assert (image.to_world(image.positions) - wanted)[known].abs().max() < 1e-12
    assert torch.allclose(image.to_world(image.from_world(wanted)), wanted, atol=1e-12)


@settings(max_examples=10)
@given(masks, st.floats(-math.pi, math.pi), st.tuples(st.floats(-9, 9), st.floats(-9, 9)))
def test_it_does_not_matter_where_the_motion_stands_and_faces(known, turn, shift):
    motion = walk(FRAMES, turn_rate=2.0)
    here, there = shown(motion, known), shown(moved(motion, turn=turn, shift=shift), known)
    assert torch.allclose(here.positions, there.positions, atol=1e-9)
    assert torch.equal(here.contacts, there.contacts)
    apart = rotations.wrap_angle(there.heading - here.heading - turn)
    assert apart.abs().max() < 1e-9
