"""What a motion lacks, and lines across it."""

from dataclasses import replace

import pytest
import torch
from captures import apart_deg, on_rig
from helpers import walk
from scipy.spatial.transform import Rotation, Slerp

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.recording.masks import ALL, ROOT, Mask


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
    made = interpolate_missing(motion, MissingMask.of_frames(lost, motion.num_joints))
    wanted = interpolated(motion.local_quat_xyzw, start, stop)
    assert apart_deg(made.local_quat_xyzw[start:stop], wanted).max() < 1e-5
    pairs = [(made.root_position, motion.root_position)]
    pairs += [(made.moving_offsets[joint], values) for joint, values in motion.moving_offsets.items()]
    weight = (torch.arange(start, stop).double() - (start - 1))[:, None] / (stop - start + 1)
    for found, given in pairs:
        line = (1 - weight) * given[start - 1] + weight * given[stop]
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
    """Of what slerp misses; with one frame after the gap only the velocity before it is known."""
    motion = swung(1.5, fps)
    start = stop = motion.num_frames // 3
    stop += round(0.2 * fps)
    motion = motion.slice(0, stop + after)
    truth, made = motion.joint_positions(), interpolate_missing(motion, lost_of(motion, Mask(ALL, start, stop)))
    lost = torch.ones(stop + after, dtype=torch.bool)
    lost[[start - 1, stop]] = False
    straight = interpolate_missing(motion, MissingMask.of_frames(lost, motion.num_joints))

    def error(found):
        return (found.joint_positions() - truth)[start:stop].norm(dim=-1).mean()

    assert error(made) < left * error(straight)
    seam = torch.diff(made.joint_positions()[start - 2 : start + 1], n=2, dim=0).norm(dim=-1).max()
    assert seam < 0.5 * torch.diff(straight.joint_positions()[start - 1 : start + 1], dim=0).norm(dim=-1).max()


def names_of(motion, lost):
    """Of joints that are lost in any frame."""
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
        ([Mask(ALL, 5, 31)], "the gap 5:31 ends after the motion's 30 frames"),
        ([Mask(ALL, 0, 30)], "leave nothing of the motion's 30 frames"),
        ([Mask(ALL, 0, 15), Mask(ALL, 15, 30)], "leave nothing"),
        ([Mask(ROOT, 0, 30)], "leave nothing"),
    ],
)
def test_what_cannot_be_is_refused(masks, message):
    with pytest.raises(RequestError, match=message):
        lost_of(on_rig("canonical", 30), *masks)
