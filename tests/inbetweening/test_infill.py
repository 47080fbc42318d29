"""Filling gaps on any rig: what is known stays, which proposal is taken, seams, and the root trajectory."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from captures import apart_deg, error_cm, on_rig, swaying, vectors
from helpers import generator, quat_xyzw, random_motion, tiny_density, walk
from methods import by_method
from tiny_infiller import tiny_infiller
from tiny_path import ToldPath, tiny_path
from tiny_transformer import tiny_transformer

from controllers import retraced
from controllers.inbetweening.infill import infill
from controllers.inbetweening.pipeline import CanonicalClip, take_simpler
from controllers.inbetweening.proposers import STANDING_STILL, AutoInbetweener, SlerpInbetweener
from controllers.inbetweening.tween import tween
from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening import GapQuery, PositionImage, Proposal, ProposedPositions
from mapctl.inbetweening.missing import interpolate_missing
from mapctl.inbetweening.position_image import propose_from_positions
from mapctl.inbetweening.query import estimate_contact_logits
from mapctl.inbetweening.root_trajectory import close_path
from mapctl.intent.keyframes import Keys
from mapctl.motion import Motion
from mapctl.numerics.smooth_offsets import blend_seams_in_positions, blend_seams_in_rotations
from mapctl.protocols import Inbetweener
from mapctl.recording.masks import ALL, ROOT, Mask, MissingMask, restore_observed
from mapctl.skeleton import CANONICAL, TOE_JOINTS, leg_length

RIGS = ("canonical", "bandai", "daz")


def filled(motion, *masks, method="infiller", drawn=0.2, infiller=None, **options):
    network = infiller if infiller is not None else tiny_infiller(drawn=drawn)
    inbetweener, refinement = by_method(method, network)
    return infill(motion, inbetweener, masks, refinement=refinement, **options)


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
class Oracle(Inbetweener):
    """Knows the motion."""

    truth: Motion

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        return propose_from_positions(query, self.complete, "oracle")

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
def test_gaps_at_either_end_are_extended_into_and_reported(method):
    motion = on_rig("bandai", 50)
    masks = [Mask(ALL, 0, 8), Mask(ALL, 42, 50)]
    done = filled(motion, *masks, method=method)
    assert_known_stays(motion, done.motion, masks)
    assert [note.partition(":")[0] for note in done.notes][:2] == ["a gap at the beginning", "a gap at the end"]


def test_standing_with_a_foot_on_a_step_is_not_lifted_off_the_floor():
    motion = still(60)
    quats = motion.local_quat_xyzw.clone()
    bend = torch.tensor(1.2, dtype=torch.float64)
    quats[:, CANONICAL.index("leftUpperLeg")] = rotations.from_rotation_vector(torch.stack([-bend, 0 * bend, 0 * bend]))
    quats[:, CANONICAL.index("leftLowerLeg")] = rotations.from_rotation_vector(torch.stack([bend, 0 * bend, 0 * bend]))
    motion = replace(motion, local_quat_xyzw=quats)
    toes = motion.joint_positions()[0, TOES, 1]
    assert toes[0] - toes[1] > 0.2
    done = infill(motion, SlerpInbetweener(), [Mask(ALL, 20, 40)]).motion
    assert (done.root_position - motion.root_position).norm(dim=-1).max() < 0.015


TOES = list(TOE_JOINTS)


class Network(Inbetweener):
    """Stands for a network: straight lines, along which the body sways aside by so many metres, and one hand waves."""

    def __init__(self, sway, wave):
        self.sway, self.wave = sway, wave

    def propose(self, query, *, generator=None):
        bump = torch.sin(torch.linspace(0, torch.pi, query.motion.num_frames).double())
        root, quats = query.motion.root_position.clone(), query.motion.local_quat_xyzw.clone()
        root[:, 0] += self.sway * query.missing.root * bump
        shoulder, angle = CANONICAL.index("leftUpperArm"), torch.zeros(len(root), 3).double()
        angle[:, 2] = self.wave * query.missing.root * bump
        quats[:, shoulder] = rotations.multiply(quats[:, shoulder], rotations.from_rotation_vector(angle))
        motion = replace(query.motion, root_position=root, local_quat_xyzw=quats)
        return Proposal(motion, torch.zeros(query.motion.num_frames, 2), "network")


def chosen(motion, start, stop, network):
    """The query of a motion that lacks frames, and what is proposed for it."""
    query = CanonicalClip.of(motion, lost_of(motion, [Mask(ALL, start, stop)])).query()
    return query, AutoInbetweener(network).propose(query)


def still(frames):
    return walk(2).pick(torch.zeros(frames, dtype=torch.long))


def test_a_standing_character_stays():
    motion = still(121)
    wandering = tiny_transformer(drawn=0.5)
    done = tween(motion, Keys((0, 120)), AutoInbetweener(wandering, [tiny_density()]))
    assert [source.by for source in done.sources] == [STANDING_STILL]
    away = (done.motion.root_position - motion.root_position).norm(dim=-1)
    assert away.max() < 0.02
    assert any("standing still" in note for note in done.gap_notes)


@pytest.mark.parametrize(
    ("sway", "frames", "by"), [(0.01, 90, "network"), (0.06, 90, STANDING_STILL), (0.06, 40, "network")]
)
def test_a_standing_character_may_gesture_but_not_drift(sway, frames, by):
    motion = still(frames + 2)
    query, answer = chosen(motion, 1, frames + 1, Network(sway=sway, wave=1.5))
    assert [source.by for source in answer.attribute(query)] == [by]
    hand = CANONICAL.index("leftHand")
    moved = (answer.motion.joint_positions() - motion.joint_positions())[:, hand].norm(dim=-1)
    assert (float(moved.max()) > 0.3) == (by == "network")


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
    return infill(motion, inbetweener, list(masks), refinement=None)


def error(result, truth, frames):
    return float((result.joint_positions() - truth.joint_positions())[frames].norm(dim=-1).mean())


def straight(motion, *masks):
    return interpolate_missing(motion, lost_of(motion, masks))


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
    root = motion.root_position.clone()
    root[at:55, 1] += leap
    missing = lost_of(motion, [Mask(ALL, 40, 55)])
    lost = missing.root
    simple = interpolate_missing(motion, missing)
    result, notes = take_simpler(replace(motion, root_position=root), simple, missing)
    wanted = simple.root_position if taken else root
    assert torch.allclose(result.root_position[lost], wanted[lost])
    assert torch.equal(result.root_position[~lost], motion.root_position[~lost])
    assert bool(notes) == taken


SEAM_FRAMES = 120
GAPS = [(40, 70), (50, 51), (0, 20), (117, 119)]


def gap_mask(start, stop, frames=SEAM_FRAMES):
    put = torch.zeros(frames, dtype=torch.bool)
    put[start:stop] = True
    return put


def way(fps=30.0, frames=SEAM_FRAMES):
    """A smooth way (frames, 3), metres."""
    return vectors(frames, 1, fps=fps)[:, 0] + torch.arange(frames).double()[:, None] / fps


def turning_bends(quats):
    return torch.diff(rotations.turns_between(quats[:-1], quats[1:]), dim=0).norm(dim=-1)


@pytest.mark.parametrize(("start", "stop"), GAPS)
def test_known_frames_stay_to_the_bit(start, stop):
    put = gap_mask(start, stop)
    wild = way() + put[:, None] * torch.randn(SEAM_FRAMES, 3, generator=generator(), dtype=torch.float64)
    assert torch.equal(blend_seams_in_positions(wild, put, fps=30.0)[~put], wild[~put])
    quats, turned = swaying(SEAM_FRAMES, 2), swaying(SEAM_FRAMES, 2, seed=5)
    quats[start:stop, 1] = turned[start:stop, 1]
    masks = torch.stack([torch.zeros_like(put), put], dim=1)
    closed = blend_seams_in_rotations(quats, masks, fps=30.0)
    assert torch.equal(closed[~masks], quats[~masks])


@pytest.mark.parametrize(("start", "stop"), GAPS)
def test_the_truth_is_left_nearly_alone(start, stop):
    put, truth = gap_mask(start, stop), way()
    assert (blend_seams_in_positions(truth, put, fps=30.0) - truth).norm(dim=-1).max() < 0.005
    quats = swaying(SEAM_FRAMES, 3)
    closed = blend_seams_in_rotations(quats, put[:, None].expand(-1, 3), fps=30.0)
    assert apart_deg(closed, quats).max() < 0.5


@pytest.mark.parametrize("fps", [30.0, 120.0])
@pytest.mark.parametrize(("start", "stop"), GAPS[:2])
def test_a_leap_at_the_edges_is_closed(start, stop, fps):
    frames = int(SEAM_FRAMES * fps / 30)
    put = gap_mask(int(start * fps / 30), int(stop * fps / 30), frames)[:, None]
    truth = swaying(frames, 1, fps=fps)
    turn = quat_xyzw(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)).expand(frames, 1, 4)
    leapt = torch.where(put[..., None], rotations.multiply(truth, turn), truth)
    closed = blend_seams_in_rotations(leapt, put, fps=fps)
    assert turning_bends(leapt).max() > 0.3
    assert turning_bends(closed).max() < 0.2 * turning_bends(leapt).max()
    leapt = way(fps, frames) + 0.3 * put
    bends, closed_bends = (
        torch.diff(each, n=2, dim=0).norm(dim=-1).max()
        for each in (leapt, blend_seams_in_positions(leapt, put[:, 0], fps=fps))
    )
    assert bends > 0.25
    assert closed_bends < 0.2 * bends


RETRACED_FRAMES = 80
CASES = [("canonical", 30), ("bandai", 30), ("daz", 30), ("daz", 120)]


def told_by(motion, stretch=1.0):
    """The motion's own trajectory at the prior's rate and of unit size."""
    canonical = retarget.to_canonical(motion)[0].resample(30)
    scale = leg_length(canonical.skeleton) / leg_length(CANONICAL)
    small = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    return ToldPath(small, stretch)


def hips_of(motion):
    return retarget.to_canonical(motion)[0].root_position


def elsewhere(motion, start, stop):
    """The motion with the hips strewn about in these frames."""
    spread = 3 * torch.randn(stop - start, 3, generator=generator(), dtype=torch.float64)
    if motion.moving_offsets:
        moving = {joint: values.clone() for joint, values in motion.moving_offsets.items()}
        moving[min(moving)][start:stop] += spread
        return replace(motion, moving_offsets=moving)
    root = motion.root_position.clone()
    root[start:stop] += spread
    return replace(motion, root_position=root)


@pytest.mark.parametrize(("rig", "fps"), CASES)
def test_a_true_prediction_gives_back_the_way_and_what_is_known_stays_to_the_bit(rig, fps):
    motion = on_rig(rig, RETRACED_FRAMES * fps // 30, fps=fps)
    start, stop = fps // 2, 2 * fps
    masks = [Mask(ROOT, start, stop)]
    done = retraced(elsewhere(motion, start, stop), told_by(motion), masks, refinement=None)
    assert float((hips_of(done.motion) - hips_of(motion)).norm(dim=-1).max()) < (0.005 if fps == 30 else 0.01)
    assert_known_stays(motion, done.motion, masks)
    assert torch.equal(done.motion.local_quat_xyzw, motion.local_quat_xyzw)


@pytest.mark.parametrize("edges", [(20, 60), (0, 50), (30, RETRACED_FRAMES), (0, RETRACED_FRAMES)])
def test_where_the_hips_were_while_they_are_lost_does_not_matter(edges):
    motion, masks = walk(RETRACED_FRAMES), [Mask(ROOT, *edges)]
    found = [retraced(each, tiny_path(), masks, refinement=None).motion for each in (motion, elsewhere(motion, *edges))]
    assert torch.equal(found[0].root_position, found[1].root_position)
    assert bool(found[0].root_position.isfinite().all())


def test_standing_is_not_moved_by_residuals_of_the_walk_after_it():
    """20 frames of standing, then 20 of walking, which end 10 cm beside the place that is known."""
    steps = torch.zeros(42, 3)
    steps[21:, 2] = 0.04
    predicted = torch.cumsum(steps, dim=0)
    known = predicted.clone()
    known[41:, 0] = 0.1
    lost = torch.zeros(42, dtype=torch.bool)
    lost[1:41] = True
    found = close_path(predicted, known, lost)
    assert float((found[:21] - predicted[:21]).abs().max()) < 0.001
    assert float(torch.diff(found[:, 0]).max()) < 0.006
    assert float((found[40] - known[41]).norm()) < 0.05


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        ([Mask(ROOT, 10, 90)], "ends at 90, the recording at 80"),
        (
            [Mask(ROOT, 0, RETRACED_FRAMES), Mask("leftHand", 5, 9)],
            "over all frames of a motion whose joints are lost as well",
        ),
        ([Mask("leftHand", 5, 9)], "there is nothing to predict"),
        ([Mask("leftElbow7", 5, 9)], "no joint"),
        ([], "nothing to predict"),
    ],
)
def test_masks_that_do_not_fit_are_refused(masks, message):
    with pytest.raises(RequestError, match=message):
        retraced(walk(RETRACED_FRAMES), tiny_path(), masks, inbetweener=SlerpInbetweener(), refinement=None)
