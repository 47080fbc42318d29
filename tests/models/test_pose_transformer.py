"""The pose transformer: what it keeps, what it is given, and its two stages."""

import math
from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import corpus
from tiny_transformer import network, tiny_transformer

from controllers.inbetweening.pipeline import CanonicalClip
from mapctl import rotations
from mapctl.inbetweening.partial_motion import KnownParts
from mapctl.motion import Motion
from mapctl.numerics.intervals import count_frames_to_observed
from mapctl.recording.masks import ALL, Mask, MissingMask
from mapctl.retarget import to_canonical
from priors import pose_transformer as module
from priors.training.recipes.pose_transformer import hide
from priors.training.windows import PoseWindows

FRAMES = 50


DRAWN = tiny_transformer(drawn=0.05)


GAP = [Mask(ALL, 15, 25)]


ARM = [Mask("leftLowerArm", 0, FRAMES), Mask("leftHand", 0, FRAMES)]


def query_of(masks, rig="canonical", frames=FRAMES):
    motion = on_rig(rig, frames)
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


def moved(motion: Motion, angle: float, shift) -> Motion:
    """Turned about +Y, then shifted."""
    turn = torch.tensor(angle, dtype=torch.float64)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(rotations.about_y(turn).expand(len(quats), 4), quats[:, 0])
    root = rotations.rotate_about_y(motion.root_position, turn) + torch.tensor(shift, dtype=torch.float64)
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def apart(one: Motion, other: Motion) -> float:
    return float((one.joint_positions() - other.joint_positions()).norm(dim=-1).max())


@pytest.mark.parametrize("masks", [GAP, ARM, [Mask(ALL, 0, 6), Mask(ALL, 44, FRAMES)]], ids=["gap", "arm", "ends"])
def test_untrained_it_interpolates_and_drawn_it_does_not(masks):
    query = query_of(masks)
    calm, drawn = (tiny_transformer(drawn=size).propose(query).motion for size in (0.0, 0.5))
    if masks is not ARM:  # joints that are never known take the mean pose, not the query's guess
        assert apart(calm, query.motion) < 0.1  # seams are blended
    assert apart(drawn, query.motion) > 0.15


def test_what_is_known_keeps_the_query_s_numbers():
    query = query_of(ARM)
    result = DRAWN.propose(query).motion
    assert torch.equal(result.root_position, query.motion.root_position)
    known = ~query.missing.joints
    turn = rotations.multiply(rotations.inverse(query.motion.local_quat_xyzw), result.local_quat_xyzw)
    assert float(rotations.to_rotation_vector(turn).norm(dim=-1)[known].max()) < 1e-6


def test_values_within_a_gap_do_not_matter():
    query = query_of(GAP)
    garbage = moved(query.motion, 2.0, (5.0, 1.0, -3.0))
    missing = query.missing.frames
    root = torch.where(missing[:, None], garbage.root_position, query.motion.root_position)
    quats = torch.where(missing[:, None, None], garbage.local_quat_xyzw, query.motion.local_quat_xyzw)
    other = replace(query, motion=replace(query.motion, root_position=root, local_quat_xyzw=quats))
    assert apart(DRAWN.propose(query).motion, DRAWN.propose(other).motion) < 1e-5


def test_a_gap_longer_than_the_training_windows_is_left_and_reported():
    frames = module.MAX_GAP_FRAMES + 40
    query = query_of([Mask(ALL, 15, 20), Mask(ALL, 30, 31 + module.MAX_GAP_FRAMES)], frames=frames)
    answer = DRAWN.propose(query)
    short, long = answer.attribute(query)
    assert (short.by, short.reason, long.by) == ("transformer", "", "interpolation")
    assert "8 s" in long.reason
    part = query.motion.slice(30, 31 + module.MAX_GAP_FRAMES)
    assert apart(answer.motion.slice(30, 31 + module.MAX_GAP_FRAMES), part) < 1e-9
    assert apart(answer.motion.slice(15, 20), query.motion.slice(15, 20)) > 0.005


def windows(count=3, frames=30):
    drawn = PoseWindows(corpus(2, 80)).draw(count, frames, torch.Generator().manual_seed(0))
    return drawn


def with_gap(motion, start, stop):
    given = torch.ones(motion.heading.shape, dtype=torch.bool)
    given[:, start:stop] = False
    return replace(motion, known=KnownParts.whole(given))


def test_untrained_both_stages_interpolate_and_what_is_known_stays():
    hidden = with_gap(windows(), 10, 20)
    untrained = network()
    shown = hide(untrained, hidden)
    proposed = untrained(shown)
    positions, guess = proposed.poses(hidden.offsets)[0], shown.world_poses()[0]
    torch.testing.assert_close(positions, guess, atol=1e-4, rtol=0)
    torch.testing.assert_close(proposed.rough.poses(hidden.offsets)[0], guess, atol=1e-4, rtol=0)
    drawn = network(drawn=0.2)
    result = drawn(hide(drawn, hidden))
    truth = hidden.world_poses()[0]
    torch.testing.assert_close(result.poses(hidden.offsets)[0][:, :10], truth[:, :10], atol=1e-4, rtol=0)
    assert float((result.poses(hidden.offsets)[0] - truth)[:, 10:20].norm(dim=-1).mean()) > 0.02


def with_tilt_alone(motion):
    """The tilt of hips in a gap is known, not their heading."""
    hidden = with_gap(motion, 10, 20)
    rotations = hidden.known.rotations.clone()
    rotations[:, 10:20, 0] = True
    return replace(hidden, known=replace(hidden.known, rotations=rotations))


@pytest.mark.parametrize("hide_parts", [lambda motion: with_gap(motion, 10, 20), with_tilt_alone])
def test_the_second_stage_adds_to_what_the_first_proposes(hide_parts):
    hidden = hide_parts(windows())
    result = network(drawn=0.2)
    for parameter in result.detail.head.parameters():
        torch.nn.init.zeros_(parameter)
    proposed = result(hide(result, hidden))
    torch.testing.assert_close(proposed.local_matrix, proposed.rough.local_matrix, atol=1e-5, rtol=0)
    torch.testing.assert_close(proposed.root_position, proposed.rough.root_position)
    torch.nn.init.normal_(result.detail.head.weight, std=0.2)
    corrected = result(hide(result, hidden))
    torch.testing.assert_close(corrected.rough.local_matrix, proposed.rough.local_matrix)
    assert float((corrected.local_matrix - proposed.local_matrix)[:, 10:20].abs().max()) > 0.01


def test_frames_since_and_until_an_observed_one_are_infinite_where_there_is_none():
    observed = torch.tensor([[False, True, False, False, True, False], [False] * 6])
    found = count_frames_to_observed(observed)
    assert found[0].T.tolist() == [[math.inf, 0, 1, 2, 0, 1], [1, 0, 2, 1, 0, math.inf]]
    assert bool(found[1].isinf().all())
