"""A proposal counts as far as it is likelier to be near the truth than interpolation is."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from helpers import walk

from controllers.inbetweening.infill import InfillSettings, infill
from controllers.inbetweening.pipeline import take_simpler
from mapctl import rotations
from mapctl.inbetweening import GapQuery, Proposal
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import ALL, Mask
from mapctl.skeleton import CANONICAL

ARM = CANONICAL.indices(("leftUpperArm", "leftLowerArm"))


@dataclass(frozen=True, eq=False)
class Guess(Inbetweener):
    """Proposes the truth with its arms and legs turned by so much, where they are missing, and claims an error."""

    truth: Motion
    wrong: float
    """Radians."""
    claim: float
    """Metres."""
    asked: ClassVar[list[int]] = []

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        self.asked.append(int(query.missing.frames.sum()))
        motion = self.truth.resample(30)
        turn = torch.zeros(motion.num_joints, 3).double()
        turn[CANONICAL.indices(("leftUpperArm", "rightUpperArm", "leftUpperLeg", "rightUpperLeg")), 0] = self.wrong
        quats = rotations.multiply(motion.local_quat_xyzw, rotations.from_rotation_vector(turn))
        quats = torch.where(query.missing.joints[..., None], quats, query.motion.local_quat_xyzw)
        root = torch.where(query.missing.root[:, None], motion.root_position, query.motion.root_position)
        result = replace(query.motion, local_quat_xyzw=quats, root_position=root)
        spread = torch.full((motion.num_frames, motion.num_joints, 2), self.claim)
        return Proposal(result, estimate_contact_logits(result), "guess", spread=spread)


def fill(motion, inbetweener, *masks):
    """Frames are refined by no MAP stage, so that what is seen is the shrinkage."""
    return infill(motion, inbetweener, list(masks), settings=InfillSettings(refine=False))


def error(result, truth, frames):
    return float((result.joint_positions() - truth.joint_positions())[frames].norm(dim=-1).mean())


def straight(motion, *masks):
    lost = torch.zeros(motion.num_frames, dtype=torch.bool)
    for mask in masks:
        lost[mask.start : mask.stop] = True
    return interpolate_missing(motion, MissingMask.of_frames(lost, motion.num_joints))


@pytest.mark.parametrize("claim", [0.01, 0.3])
@pytest.mark.parametrize(("start", "stop", "frames"), [(40, 55, 100), (40, 50, 200), (10, 15, 16), (10, 25, 26)])
def test_a_network_that_is_wrong_is_outweighed_whatever_it_claims(start, stop, frames, claim):
    """Where it was tested. With 10 frames before and one after as well as within a long clip."""
    motion = walk(frames)
    result = fill(motion, Guess(motion, wrong=0.8, claim=claim), Mask(ALL, start, stop))
    simple = error(straight(motion, Mask(ALL, start, stop)), motion, slice(start, stop))
    assert error(result.motion, motion, slice(start, stop)) < 1.05 * simple + 0.0015
    (note,) = result.gap_notes
    assert "interpolation: the motion is unfamiliar to the guess" in note


@pytest.mark.parametrize(("start", "stop", "frames"), [(40, 55, 100), (10, 25, 26)])
def test_a_network_that_is_right_is_followed(start, stop, frames):
    motion = walk(frames)
    result = fill(motion, Guess(motion, wrong=0.0, claim=0.01), Mask(ALL, start, stop))
    simple = error(straight(motion, Mask(ALL, start, stop)), motion, slice(start, stop))
    assert error(result.motion, motion, slice(start, stop)) < 0.15 * simple
    assert "unfamiliar" not in result.gap_notes[0]


@pytest.mark.parametrize("fps", [30, 60])
def test_a_lost_arm_that_both_ends_hold_still_does_not_drop(fps):
    """All else walks on and is known; the network lowers the arm, and is as sure as ever."""
    motion = walk(4 * fps, fps=fps)
    quats = motion.local_quat_xyzw.clone()
    quats[:, ARM] = rotations.from_rotation_vector(torch.tensor([0.0, 0.9, 0.3]).double())
    motion = replace(motion, local_quat_xyzw=quats)
    gap = slice(round(1.5 * fps), round(2.5 * fps))
    masks = [Mask(name, gap.start, gap.stop) for name in ("leftUpperArm", "leftLowerArm", "leftHand")]
    result = fill(motion, Guess(motion, wrong=1.0, claim=0.02), *masks)
    assert 100 * error(result.motion, motion, gap) < 0.5


def test_bare_poses_are_no_evidence_against_the_network():
    motion, lost = walk(61), Mask(ALL, 1, 60)
    result = fill(motion, Guess(motion, 0.0, 5.0), lost)
    simple = error(straight(motion, lost), motion, slice(1, 60))
    assert error(result.motion, motion, slice(1, 60)) < 0.05 * simple


@pytest.mark.parametrize(("leap", "taken"), [(0.5, True), (0.02, False)])
@pytest.mark.parametrize("at", [40, 47])
def test_an_answer_that_leaps_where_the_clip_does_not_is_not_taken(at, leap, taken):
    motion = walk(90)
    lost = torch.zeros(90, dtype=torch.bool)
    lost[40:55] = True
    root = motion.root_position.clone()
    root[at:55, 1] += leap
    missing = MissingMask.of_frames(lost, motion.num_joints)
    simple = interpolate_missing(motion, missing)
    result, notes = take_simpler(replace(motion, root_position=root), simple, missing)
    wanted = simple.root_position if taken else root
    assert torch.allclose(result.root_position[lost], wanted[lost])
    assert torch.equal(result.root_position[~lost], motion.root_position[~lost])
    assert bool(notes) == taken
