"""Hands and feet at wanted places, with the whole body: reached, feet where they stood, no more moved than it takes."""

import pytest
import torch
from captures import on_rig
from helpers import walk

from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.whole_body import reach_targets
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL

JOINTS = CANONICAL.num_joints
HAND, SHOULDER = CANONICAL.index("leftHand"), CANONICAL.index("leftUpperArm")
FEET = [CANONICAL.index(name) for name in ("leftFoot", "rightFoot", "leftToes", "rightToes")]


def asked(motion, frame, joint, place):
    places = motion.joint_positions().clone()
    wanted = torch.zeros(motion.num_frames, JOINTS, dtype=torch.bool)
    places[frame, joint], wanted[frame, joint] = place, True
    return EffectorTargets(places, wanted)


def reach(motion, targets, *, stray=0.0, turning=None, moving=None):
    all_of_it = torch.ones(motion.num_frames, JOINTS, dtype=torch.bool)
    turning = all_of_it if turning is None else turning
    moving = all_of_it[:, 0] if moving is None else moving
    return reach_targets(motion, targets, turning=turning, moving=moving, stray=torch.full((motion.num_frames,), stray))


def beside(motion, frame, *, ahead=0.0, aside=0.0, up=0.0):
    """A place seen from the left shoulder of somebody who faces +Z, metres."""
    return motion.joint_positions()[frame, SHOULDER] + torch.tensor([aside, up, ahead]).double()


@pytest.mark.parametrize(
    "where",
    [
        {"ahead": 0.3},
        {"ahead": 0.62},
        {"up": -1.1, "ahead": 0.35},
        {"aside": 0.55},
        {"up": 0.5},
        {"ahead": 0.05, "up": -0.1},
    ],
)
def test_a_hand_gets_there_and_standing_feet_stay(where):
    motion = walk(5, cadence=0.0)
    place = beside(motion, 2, **where)
    made, shift = reach(motion, asked(motion, 2, HAND, place))
    places, before = made.joint_positions(), motion.joint_positions()
    assert (places[2, HAND] - place).norm() < 0.005
    assert (places[2, FEET] - before[2, FEET]).norm(dim=-1).max() < 0.02  # at most a heel comes up for what is high
    assert shift.norm() < 1e-6
    others = [0, 1, 3, 4]
    assert torch.equal(made.local_quat_xyzw[others], motion.local_quat_xyzw[others])


def test_somebody_on_the_way_is_rather_a_little_further_than_stretched():
    motion = walk(3, cadence=0.0)
    targets = asked(motion, 1, HAND, beside(motion, 1, ahead=0.9))
    made, shift = reach(motion, targets, stray=0.5)
    assert shift[1, 2] > 0.3
    feet = (made.joint_positions() - motion.joint_positions())[1, FEET]
    torch.testing.assert_close(feet, shift[1].expand_as(feet), atol=1e-3, rtol=0)


def test_what_may_not_move_does_not_and_bones_keep_their_lengths():
    motion = to_canonical(on_rig("bandai", 5))[0]
    targets = asked(motion, 2, HAND, beside(motion, 2, ahead=0.6))
    turning = torch.zeros(5, JOINTS, dtype=torch.bool)
    turning[:, [SHOULDER, CANONICAL.index("leftLowerArm")]] = True
    made, _ = reach(motion, targets, turning=turning, moving=torch.zeros(5, dtype=torch.bool))
    kept = ~turning[0]
    assert torch.equal(made.local_quat_xyzw[:, kept], motion.local_quat_xyzw[:, kept])
    assert torch.equal(made.root_position, motion.root_position)
    bones = [
        (each[:, 1:] - each[:, list(CANONICAL.parents[1:])]).norm(dim=-1)
        for each in (made.joint_positions(), motion.joint_positions())
    ]
    torch.testing.assert_close(*bones, atol=1e-9, rtol=0)
