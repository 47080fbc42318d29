"""Hands that reach and heads that look while a character is steered."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import walk

from controllers.steering.overlay import Overlay
from mapctl.intent.steering import Command
from mapctl.kinematics.moving import measure_look_angle
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOES

STEP, AHEAD = 3, 31


def steered(motion: Motion, command_at) -> Motion:
    """Every frame of a motion, three at a time, by what is commanded at each."""
    overlay, pieces, joints = Overlay(), [], motion.joint_positions()
    for first in range(0, motion.num_frames - STEP + 1, STEP):
        piece = motion.slice(first, first + STEP)
        overlay, posed = overlay.pose(piece, command_at(first / 30), joints[first + STEP : first + STEP + AHEAD])
        pieces.append(posed)
    quats = torch.cat([piece.local_quat_xyzw for piece in pieces])
    return replace(motion.slice(0, len(quats)), local_quat_xyzw=quats)


def standing(seconds: float) -> Motion:
    """A character that does not move, with arms that hang."""
    return walk(2).pick(torch.zeros(round(seconds * 30), dtype=torch.long))


def near(motion: Motion, hand: str, away: tuple[float, float, float]) -> tuple[float, float, float]:
    """A place so far from a hand's shoulder in the first frame."""
    shoulder = motion.joint_positions()[0, CANONICAL.index(hand.replace("Hand", "UpperArm"))]
    x, y, z = (shoulder + torch.tensor(away, dtype=shoulder.dtype)).tolist()
    return x, y, z


def misses(motion: Motion, hand: str, position) -> torch.Tensor:
    at = motion.joint_positions()[:, CANONICAL.index(hand)]
    return (at - at.new_tensor(position)).norm(dim=-1)


@pytest.mark.slow
@pytest.mark.parametrize("hand", ["leftHand", "rightHand"])
@pytest.mark.parametrize("away", [(0.05, -0.1, 0.4), (0.3, 0.25, 0.1), (0.0, -0.3, 0.3), (-0.1, 0.1, 0.45)])
def test_a_hand_comes_to_its_place_stays_and_goes_back(hand, away):
    motion = standing(4.0)
    position = near(motion, hand, away if hand == "leftHand" else (-away[0], *away[1:]))
    printed = Command(0.0, 0.0, reach={hand: position})
    found = steered(motion, lambda seconds: printed if 0.5 <= seconds < 2.0 else Command(0.0, 0.0))
    missed = misses(found, hand, position)
    assert float(missed[40:60].max()) < 0.005
    np.testing.assert_array_equal(found.local_quat_xyzw[:15], motion.local_quat_xyzw[:15])
    np.testing.assert_allclose(found.joint_positions()[-20:], motion.slice(0, 120).joint_positions()[-20:], atol=1e-9)
    feet = CANONICAL.indices(TOES)
    np.testing.assert_allclose(found.joint_positions()[:, feet], motion.joint_positions()[:120, feet], atol=1e-9)


def test_what_is_far_or_behind_is_left_alone():
    motion = standing(2.0)
    for away in ((0.0, 0.0, 1.6), (0.0, -0.1, -0.45)):
        position = near(motion, "leftHand", away)
        found = steered(motion, lambda seconds, position=position: Command(0.0, 0.0, reach={"leftHand": position}))
        np.testing.assert_allclose(found.joint_positions(), motion.joint_positions(), atol=1e-9)


@pytest.mark.slow
def test_places_that_are_dragged_make_no_hand_jump():
    """Ten times a second the place is somewhere else, also out of reach, and the hand changes."""
    motion, generator = walk(240), np.random.default_rng(3)
    joints = motion.joint_positions()
    calm = [torch.diff(joints[:, CANONICAL.indices(("leftHand", "rightHand", "head"))], n=n, dim=0) for n in (1, 2)]
    commands = {}
    for number in range(80):
        around = joints[min(239, 3 * number), CANONICAL.index("chest")]
        position = tuple((around.numpy() + generator.uniform(-0.9, 0.9, 3)).tolist())
        hands = {("leftHand", "rightHand")[generator.integers(2)]: position} if generator.random() < 0.8 else {}
        commands[number] = Command(1.2, 0.0, reach=hands, look_at=position if generator.random() < 0.8 else None)
    found = steered(motion, lambda seconds: commands[round(seconds * 10)])
    hands = found.joint_positions()[:, CANONICAL.indices(("leftHand", "rightHand", "head"))]
    speed, bend = (torch.diff(hands, n=n, dim=0).norm(dim=-1) * 30**n for n in (1, 2))
    assert float(speed.max()) < 30 * float(calm[0].norm(dim=-1).max()) + 3.5
    assert float(bend.max()) < 900 * float(calm[1].norm(dim=-1).max()) + 60


@pytest.mark.slow
def test_a_head_looks_and_what_is_behind_is_not_looked_at():
    motion = standing(3.0)
    there, behind = (1.5, 1.4, 1.5), (0.1, 1.4, -3.0)
    found = steered(motion, lambda seconds: Command(0.0, 0.0, look_at=there))
    assert float(torch.rad2deg(measure_look_angle(found, torch.tensor([there])))[-1]) < 1.0
    found = steered(motion, lambda seconds: Command(0.0, 0.0, look_at=behind))
    np.testing.assert_allclose(found.joint_positions(), motion.joint_positions(), atol=1e-6)


def test_the_walk_alone_is_the_walk_to_the_bit():
    motion = walk(60)
    overlay, posed = Overlay().pose(motion, Command(1.2, 0.0), motion.joint_positions()[:0])
    assert posed is motion
    assert not overlay.parts
