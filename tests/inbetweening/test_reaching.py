"""Hands and feet at target positions: by their limbs alone, and with the whole body."""

import pytest
import torch
from captures import on_rig
from helpers import generator, quat_xyzw, walk

from mapctl.inbetweening.effector_targets import EffectorTargets, compute_target_errors, reach_effector_targets
from mapctl.inbetweening.whole_body import reach_targets
from mapctl.motion import Motion
from mapctl.retarget import to_canonical
from mapctl.skeleton import CANONICAL, LIMBS

JOINTS = CANONICAL.num_joints
HAIR = 1e-4


def at(motion, wanted):
    """Targets by (frame, limb) to place."""
    positions = torch.zeros(motion.num_frames, JOINTS, 3).double()
    mask = torch.zeros(motion.num_frames, JOINTS, dtype=torch.bool)
    for (frame, limb), position in wanted.items():
        positions[frame, CANONICAL.index(limb)] = position
        mask[frame, CANONICAL.index(limb)] = True
    return EffectorTargets(positions, mask)


def place_of(motion, frame, joint):
    return motion.joint_positions()[frame, CANONICAL.index(joint)]


def nearer(motion, frame, limb, share=0.15, aside=0.05):
    """A place in reach: toward where the limb begins, and somewhat aside."""
    begins, ends = place_of(motion, frame, CANONICAL.names[LIMBS[limb].upper]), place_of(motion, frame, limb)
    aside = aside * torch.randn(3, generator=generator(frame)).double()
    position = ends + share * (begins - ends) + aside
    length = CANONICAL.offsets[[LIMBS[limb].lower, LIMBS[limb].end]].norm(dim=-1).sum()
    return begins + (position - begins) * min(1.0, 0.98 * float(length) / float((position - begins).norm()))


def all_free(motion):
    return torch.ones(motion.num_frames, dtype=torch.bool)


def lengths(motion):
    """Lengths of every bone in every frame."""
    positions = motion.joint_positions()
    return (positions[:, 1:] - positions[:, list(CANONICAL.parents[1:])]).norm(dim=-1)


def standing(**angles):
    """Frames in the rest pose, joints turned by rotation vectors."""
    frames = 31
    vectors = torch.zeros(frames, JOINTS, 3).double()
    for joint, vector in angles.items():
        vectors[:, CANONICAL.index(joint)] = torch.tensor(vector).double()
    root = torch.tensor([0.0, 1.0, 0.0]).double().expand(frames, 3).clone()
    return Motion(CANONICAL, walk(2).fps, root, quat_xyzw(vectors))


@pytest.mark.parametrize("limb", LIMBS)
@pytest.mark.parametrize("fps", [30, 120])
def test_places_in_reach_are_met_and_bones_stay_rigid(limb, fps):
    motion = walk(2 * fps, fps=fps, turn_rate=0.4)
    frames = (fps // 2, fps, fps + fps // 3)
    targets = at(motion, {(frame, limb): nearer(motion, frame, limb) for frame in frames})
    assert compute_target_errors(motion.joint_positions(), targets).max() > 0.03
    result = reach_effector_targets(motion, targets, all_free(motion))
    assert compute_target_errors(result.joint_positions(), targets).max() < HAIR
    assert (lengths(result) - lengths(motion)).abs().max() < 1e-12


@pytest.mark.parametrize("limb", LIMBS)
def test_only_the_limb_turns_and_only_where_it_is_free(limb):
    motion, free = walk(60), torch.zeros(60, dtype=torch.bool)
    free[20:40] = True
    result = reach_effector_targets(motion, at(motion, {(30, limb): nearer(motion, 30, limb)}), free)
    turned = (result.local_quat_xyzw != motion.local_quat_xyzw).any(dim=-1)
    assert set(turned.any(dim=0).nonzero()[:, 0].tolist()) == {LIMBS[limb].upper, LIMBS[limb].lower}
    assert torch.equal(result.local_quat_xyzw[~free], motion.local_quat_xyzw[~free])
    assert torch.equal(result.root_position, motion.root_position)


@pytest.mark.parametrize("limb", LIMBS)
def test_out_of_reach_the_limb_is_straight_and_its_miss_is_reported(limb):
    motion = walk(31)
    begins, ends = (place_of(motion, 15, joint) for joint in (CANONICAL.names[LIMBS[limb].upper], limb))
    length = float(lengths(motion)[15, [LIMBS[limb].lower - 1, LIMBS[limb].end - 1]].sum())
    way = torch.nn.functional.normalize(ends - begins + torch.tensor([0.1, 0.05, 0.1]).double(), dim=-1)
    targets = at(motion, {(15, limb): begins + (length + 0.3) * way})
    result = reach_effector_targets(motion, targets, all_free(motion)).joint_positions()
    assert (result[15, CANONICAL.index(limb)] - (begins + length * way)).norm() < 2 * HAIR
    wrong = compute_target_errors(result, targets)
    assert wrong[15] == pytest.approx(0.3, abs=2 * HAIR)
    assert wrong[:15].max() == wrong[16:].max() == 0


@pytest.mark.parametrize(("limb", "forward"), [("leftFoot", 1), ("rightFoot", 1), ("leftHand", -1), ("rightHand", -1)])
def test_straight_limbs_bend_knees_forward_and_elbows_back(limb, forward):
    motion = standing()
    upper, lower = (CANONICAL.names[joint] for joint in (LIMBS[limb].upper, LIMBS[limb].lower))
    begins, ends = place_of(motion, 15, upper), place_of(motion, 15, limb)
    result = reach_effector_targets(motion, at(motion, {(15, limb): ends + 0.2 * (begins - ends)}), all_free(motion))
    bent = place_of(result, 15, lower) - begins
    axis = torch.nn.functional.normalize(ends - begins, dim=-1)
    across = bent - (bent @ axis) * axis
    assert float(across[2]) * forward > 0.05
    assert abs(float(across[2])) == pytest.approx(float(across.norm()), rel=0.02)


HAND, SHOULDER = CANONICAL.index("leftHand"), CANONICAL.index("leftUpperArm")
FEET = [CANONICAL.index(name) for name in ("leftFoot", "rightFoot", "leftToes", "rightToes")]


def reach(motion, targets, *, stray=0.0, turning=None, moving=None):
    all_of_it = torch.ones(motion.num_frames, JOINTS, dtype=torch.bool)
    turning = all_of_it if turning is None else turning
    moving = all_of_it[:, 0] if moving is None else moving
    return reach_targets(motion, targets, turning=turning, moving=moving, stray=torch.full((motion.num_frames,), stray))


def beside(motion, frame, *, ahead=0.0, aside=0.0, up=0.0):
    """A place seen from the left shoulder of a body that faces +Z, metres."""
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
    position = beside(motion, 2, **where)
    result = reach(motion, at(motion, {(2, "leftHand"): position}))
    positions, before = result.joint_positions(), motion.joint_positions()
    assert (positions[2, HAND] - position).norm() < 0.005
    assert (positions[2, FEET] - before[2, FEET]).norm(dim=-1).max() < 0.02  # at most a heel comes up for what is high
    others = [0, 1, 3, 4]
    assert torch.equal(result.local_quat_xyzw[others], motion.local_quat_xyzw[others])


def test_an_oncoming_walker_is_passed_further_off_rather_than_stretched():
    motion = walk(3, cadence=0.0)
    targets = at(motion, {(1, "leftHand"): beside(motion, 1, ahead=0.9)})
    result = reach(motion, targets, stray=0.5)
    feet = (result.joint_positions() - motion.joint_positions())[1, FEET]
    assert float(feet[0, 2]) > 0.3
    torch.testing.assert_close(feet, feet[:1].expand_as(feet), atol=1e-3, rtol=0)


def test_what_may_not_move_does_not_and_bones_keep_their_lengths():
    motion = to_canonical(on_rig("bandai", 5))[0]
    targets = at(motion, {(2, "leftHand"): beside(motion, 2, ahead=0.6)})
    turning = torch.zeros(5, JOINTS, dtype=torch.bool)
    turning[:, [SHOULDER, CANONICAL.index("leftLowerArm")]] = True
    result = reach(motion, targets, turning=turning, moving=torch.zeros(5, dtype=torch.bool))
    kept = ~turning[0]
    assert torch.equal(result.local_quat_xyzw[:, kept], motion.local_quat_xyzw[:, kept])
    assert torch.equal(result.root_position, motion.root_position)
    torch.testing.assert_close(lengths(result), lengths(motion), atol=1e-9, rtol=0)
