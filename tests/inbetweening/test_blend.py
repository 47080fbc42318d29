"""Blending counts in the other clip's own frames, whatever the two frame rates."""

from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers import walk
from methods import UNFINISHED
from tiny_infiller import tiny_infiller

from controllers.inbetweening.blend import LimbTransfer, blend
from mapctl import rotations
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

HAND, ARM = CANONICAL.index("leftHand"), CANONICAL.index("leftUpperArm")


def waving(fps: int, seconds: float = 4.0) -> Motion:
    """Somebody who stands and lowers the left arm evenly by a radian a second from the T-pose: its angle tells when."""
    frames = round(fps * seconds)
    angle = -torch.arange(frames, dtype=torch.float64) / fps
    quats = torch.zeros(frames, CANONICAL.num_joints, 4, dtype=torch.float64)
    quats[..., 3] = 1
    quats[:, ARM] = rotations.from_rotation_vector(angle[:, None] * torch.tensor([0.0, 0.0, 1.0]).double())
    root = torch.tensor([0.0, 0.87, 0.0]).double().expand(frames, 3).clone()
    return Motion(CANONICAL, Fraction(fps), root, quats)


@pytest.mark.parametrize(("own", "other"), [(24, 120), (30, 24)])
def test_frames_are_the_other_clips_own(own, other):
    start, stop, at = round(0.5 * other), round(1.0 * other), 2 * own
    still = replace(waving(own), local_quat_xyzw=waving(own).local_quat_xyzw[:1].expand(4 * own, -1, -1))
    transfer = LimbTransfer(("lefthand",), start, stop, at)
    done = blend(still, waving(other), transfer, tiny_infiller(), settings=UNFINISHED).motion
    arm = (done.joint_positions()[:, HAND] - done.joint_positions()[:, ARM])[at : at + round(0.5 * own)]
    wanted = 0.5 + torch.arange(len(arm), dtype=torch.float64) / own
    torch.testing.assert_close(torch.atan2(-arm[:, 1], arm[:, 0]), wanted, atol=1e-3, rtol=0)


ENDS = [CANONICAL.index(name) for name in ("leftHand", "rightHand", "leftToes", "rightToes")]


def peaks_of(motion):
    return body.measure_peaks(motion.joint_positions()[:, ENDS], motion.root_position, float(motion.fps))


@pytest.mark.parametrize("fps", [30, 60])
@pytest.mark.parametrize("margin", [None, 0.5])
def test_a_borrowed_limb_goes_there_and_comes_back_as_bodies_do(fps, margin):
    """README's figures: 20 frames of a raised arm at frame 70 of a walk, without the jumps of 85 cm that there were."""
    motion, source = walk(4 * fps, fps=fps), waving(30)
    done = blend(
        motion,
        source,
        LimbTransfer(("leftHand",), 8, 28, 70 * fps // 30, margin=margin),
        tiny_infiller(),
        settings=UNFINISHED,
    )
    own, theirs, made = peaks_of(motion), peaks_of(source), peaks_of(done.motion)
    assert made.step < max(1.3 * max(own.step, theirs.step), 0.17)
    assert made.acceleration < max(1.5 * max(own.acceleration, theirs.acceleration), 60)
    assert not any("takes" in note for note in done.notes)
