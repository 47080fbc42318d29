"""Gaps that nobody marked."""

from dataclasses import replace

import pytest
import torch
from captures import apart_deg, on_rig
from helpers import quat_xyzw

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.recording.inspection import find_gaps
from mapctl.recording.masks import ALL, ROOT, Mask

RIGS = ("canonical", "bandai", "daz")


def frozen(motion, start, stop):
    """Frames start to stop repeat the one before them."""
    frame = torch.arange(motion.num_frames)
    frame[start:stop] = start - 1
    moving = {joint: values[frame] for joint, values in motion.moving_offsets.items()}
    return replace(
        motion,
        root_position=motion.root_position[frame],
        moving_offsets=moving,
        local_quat_xyzw=motion.local_quat_xyzw[frame],
    )


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


def test_a_leap_of_the_place_is_found():
    motion = on_rig("canonical", 90)
    root = motion.root_position.clone()
    root[50:52, 0] += 1.0
    assert find_gaps(replace(motion, root_position=root)) == (Mask(ROOT, 50, 52),)


def test_a_frozen_joint_in_a_body_that_moves_is_found():
    motion = on_rig("canonical", 90)
    quats = motion.local_quat_xyzw.clone()
    joint = motion.skeleton.index("leftLowerArm")
    quats[30:50, joint] = quats[29, joint]
    (mask,) = find_gaps(replace(motion, local_quat_xyzw=quats))
    assert (mask.joint, mask.stop) == ("leftLowerArm", 50)
    assert mask.start in (29, 30)


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
    with pytest.raises(RequestError, match=r"say which frames are missing \(--gap A:B\) or which joints"):
        find_gaps(spoil(on_rig(rig, 90)))
