"""Blending counts in the other clip's own frames, and pieces of a chain stand on the first one's floor."""

from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers import bandai_skeleton, generator, walk
from performers import TOES, Performer
from rig_maker import Make, make, names_of

from controllers.inbetweening.blend import LimbTransfer, blend
from controllers.inbetweening.infill import chain
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl import retarget, rotations
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT

HAND, ARM = CANONICAL.index("leftHand"), CANONICAL.index("leftUpperArm")


def waving(fps: int, seconds: float = 4.0) -> Motion:
    """A standing performer who lowers the left arm evenly by a radian a second from the T-pose: its angle is the
    time."""
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
    done = blend(still, waving(other), transfer, SlerpInbetweener(), refinement=None).motion
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
        SlerpInbetweener(),
        refinement=None,
    )
    own, theirs, result = peaks_of(motion), peaks_of(source), peaks_of(done.motion)
    assert result.step < max(1.3 * max(own.step, theirs.step), 0.17)
    assert result.acceleration < max(1.5 * max(own.acceleration, theirs.acceleration), 60)
    assert not any("takes" in note for note in done.notes)


OTHER = Performer(size=1.2, toe_height=-0.06)


def own_walk() -> Motion:
    """On the Bandai Namco rig."""
    return retarget.from_canonical(Performer().walks(), retarget.identify_rig(bandai_skeleton()))


def others_walk() -> Motion:
    """On another rig, of a tall body whose toes are below the floor."""
    return make(Make(names_of("mixamo"), size=1.2, extras=False)).motion(OTHER.walks())


def test_pieces_of_a_chain_stand_on_the_first_ones_floor():
    done = chain([own_walk(), others_walk()], SlerpInbetweener(), gap=(10, 10), refinement=None, generator=generator())
    toes = retarget.to_canonical(done.motion)[0].joint_positions()[:, TOES, 1]
    for piece in (slice(0, 40), slice(50, 90)):
        torch.testing.assert_close(toes[piece].amin(0), torch.full((2,), TOE_REST_HEIGHT).double(), atol=0.01, rtol=0)
