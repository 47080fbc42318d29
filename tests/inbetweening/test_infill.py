"""Filling gaps on any rig: what is known stays, what stood in a gap does not matter, a true proposal is met."""

from dataclasses import dataclass, replace

import pytest
import torch
from captures import error_cm, on_rig
from helpers import random_motion, walk
from methods import by_method
from tiny_infiller import tiny_infiller

from controllers.inbetweening.infill import infill
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl import retarget, rotations
from mapctl.inbetweening import PositionImage, ProposedPositions
from mapctl.inbetweening.missing import MissingMask, restore_observed
from mapctl.motion import Motion
from mapctl.protocols import PositionInfiller
from mapctl.recording.masks import ALL, Mask
from mapctl.skeleton import CANONICAL, TOE_JOINTS, leg_length

RIGS = ("canonical", "bandai", "daz")


def filled(motion, *masks, method="infiller", drawn=0.2, infiller=None, **options):
    network = infiller if infiller is not None else tiny_infiller(drawn=drawn)
    inbetweener, settings = by_method(method, network)
    return infill(motion, inbetweener, masks, settings=settings, **options)


def seconds(motion, *edges):
    """A mask of everything between two times."""
    return Mask(ALL, *(round(edge * float(motion.fps)) for edge in edges))


def lost_of(motion, masks):
    return MissingMask.of_masks(motion, masks, retarget.to_canonical(motion)[1])


def assert_known_stays(motion, result, masks):
    lost = lost_of(motion, masks)
    assert (result.num_frames, result.fps, result.skeleton) == (motion.num_frames, motion.fps, motion.skeleton)
    assert torch.equal(result.local_quat_xyzw[~lost.joints], motion.local_quat_xyzw[~lost.joints])
    assert torch.equal(result.root_position[~lost.root], motion.root_position[~lost.root])
    assert result.moving_offsets.keys() == motion.moving_offsets.keys()
    for joint, values in motion.moving_offsets.items():
        assert torch.equal(result.moving_offsets[joint][~lost.root], values[~lost.root])
    assert result.joint_positions().isfinite().all()


def same(first, second):
    quats = torch.equal(first.local_quat_xyzw, second.local_quat_xyzw)
    return quats and torch.equal(first.joint_positions(), second.joint_positions())


@pytest.mark.parametrize(
    ("rig", "fps", "method"),
    [("canonical", 30, "infiller"), ("bandai", 30, "slerp"), ("daz", 120, "infiller"), ("daz", 30, "auto")],
)
def test_known_frames_stay_to_the_bit_and_the_gap_is_filled_with_something(rig, fps, method):
    motion = on_rig(rig, 2 * fps, fps=fps)
    mask = seconds(motion, 0.7, 1.2)
    result = filled(motion, mask, method=method).motion
    assert_known_stays(motion, result, [mask])
    gap = slice(mask.start, mask.stop)
    assert (result.joint_positions()[gap] - motion.joint_positions()[gap]).norm(dim=-1).mean() > 0.002


@pytest.mark.parametrize(
    ("rig", "method"),
    [
        ("bandai", "infiller"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("canonical", "infiller"), ("daz", "slerp"))),
        ("daz", "auto"),
    ],
)
def test_what_stands_in_the_gap_does_not_matter(rig, method):
    motion = on_rig(rig, 45)
    masks = [Mask(ALL, 15, 25), Mask(motion.skeleton.names[8], 30, 40)]
    wild = random_motion(motion.skeleton, 45, seed=3)
    wild = replace(wild, moving_offsets={joint: wild.root_position for joint in motion.moving_offsets})
    corrupted = restore_observed(wild, motion, lost_of(motion, masks))
    assert not same(corrupted, motion)
    assert same(*(filled(given, *masks, method=method).motion for given in (motion, corrupted)))


@dataclass(frozen=True)
class Oracle(PositionInfiller):
    """Knows the motion."""

    truth: Motion

    def complete(self, image: PositionImage) -> ProposedPositions:
        """The true places; where there is a moment more than at 30 a second it is that of the very end."""
        own = retarget.to_canonical(self.truth)[0]
        canonical = own.resample(30)
        if image.positions.shape[1] > canonical.num_frames:
            end = own.slice(own.num_frames - 1, own.num_frames)
            canonical = canonical.join(replace(end, fps=canonical.fps))
        scale = leg_length(canonical.skeleton) / leg_length(CANONICAL)
        body = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
        positions = body.joint_positions().float()[None]
        return ProposedPositions(image.from_world(positions), torch.zeros(1, positions.shape[1], 2))


@pytest.mark.parametrize(("rig", "fps"), [("bandai", 30), ("daz", 60)])
def test_a_true_proposal_gives_the_true_motion_back(rig, fps):
    motion = on_rig(rig, 3 * fps, fps=fps)
    masks = [seconds(motion, 0.8, 1.4), seconds(motion, 2.0, 2.03 + 1 / fps)]
    result, lines = (
        filled(motion, *masks, method=method, infiller=Oracle(motion)).motion for method in ("infiller", "slerp")
    )
    # Places do not tell how a collarbone or a shin is turned about itself, and a rig's joints beside them show it.
    assert error_cm(result, motion) < 0.3 * error_cm(lines, motion)
    frames = lost_of(motion, masks).frames
    off = (result.joint_positions() - motion.joint_positions())[frames].norm(dim=-1)
    assert off.mean() < 0.01


@pytest.mark.parametrize("rig", ["daz"])
def test_a_larger_performer_is_shown_as_one_of_the_networks_size(rig):
    """Proposed positions are scaled back by the legs, rotations stay."""
    small = on_rig(rig, 60)
    motion = replace(
        small,
        skeleton=replace(small.skeleton, offsets=1.25 * small.skeleton.offsets),
        root_position=1.25 * small.root_position,
        moving_offsets={joint: 1.25 * values for joint, values in small.moving_offsets.items()},
    )
    result, unscaled = (filled(each, Mask(ALL, 20, 40), infiller=Oracle(small)).motion for each in (motion, small))
    assert (result.joint_positions() - 1.25 * unscaled.joint_positions()).norm(dim=-1).max() < 0.005


@pytest.mark.parametrize("rig", RIGS[1:])
def test_lost_joints_are_filled_and_no_other(rig):
    motion = on_rig(rig, 45)
    hand = {"canonical": "leftHand", "bandai": "Hand_L", "daz": "lHand"}[rig]
    for mask in (Mask(hand, 0, 45), Mask(hand, 10, 30)):
        result = filled(motion, mask)
        assert_known_stays(motion, result.motion, [mask])
        assert result.notes == ()
        moved = (result.motion.local_quat_xyzw != motion.local_quat_xyzw).any(dim=-1).any(dim=0)
        assert 1 <= int(moved.sum()) <= 2


@pytest.mark.parametrize("method", ["infiller", "auto"])
def test_gaps_at_the_beginning_and_the_end_are_extended_into_and_said(method):
    motion = on_rig("bandai", 50)
    masks = [Mask(ALL, 0, 8), Mask(ALL, 42, 50)]
    done = filled(motion, *masks, method=method)
    assert_known_stays(motion, done.motion, masks)
    assert [note.partition(":")[0] for note in done.notes][:2] == ["a gap at the beginning", "a gap at the end"]


def test_who_stands_with_a_foot_on_a_step_is_not_lifted_off_the_floor():
    motion = walk(60)
    quats = motion.local_quat_xyzw[:1].expand(60, -1, -1).clone()
    bend = torch.tensor(1.2, dtype=torch.float64)
    quats[:, CANONICAL.index("leftUpperLeg")] = rotations.from_rotation_vector(torch.stack([-bend, 0 * bend, 0 * bend]))
    quats[:, CANONICAL.index("leftLowerLeg")] = rotations.from_rotation_vector(torch.stack([bend, 0 * bend, 0 * bend]))
    still = replace(motion, local_quat_xyzw=quats, root_position=motion.root_position[:1].expand(60, -1).clone())
    toes = still.joint_positions()[0, list(TOE_JOINTS), 1]
    assert toes[0] - toes[1] > 0.2
    done = infill(still, SlerpInbetweener(), [Mask(ALL, 20, 40)]).motion
    assert (done.root_position - still.root_position).norm(dim=-1).max() < 0.015
