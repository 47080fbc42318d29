"""The stitcher: both ends exact, draws, and what fills gaps that cannot be stitched."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_stitcher import tiny_stitcher

from controllers.inbetweening.pipeline import CanonicalClip
from controllers.inbetweening.proposers import SlerpInbetweener, StitchedInbetweener
from controllers.inbetweening.tween import tween
from mapctl.intent.keyframes import Keys
from mapctl.recording.masks import ALL, Mask, MissingMask
from mapctl.retarget import to_canonical
from priors.stitcher import see_ends

each_length = pytest.mark.parametrize("frames", [2, 3, 4, 5, 8, 15, 24])


def query_of(motion, *gaps):
    masks = [Mask(ALL, start, stop) for start, stop in gaps]
    return CanonicalClip.of(motion, MissingMask.of_masks(motion, masks, to_canonical(motion)[1])).query()


def bare(motion, start, stop):
    """Ends of which nothing but the two poses is known."""
    missing = torch.ones(motion.num_frames, dtype=torch.bool)
    missing[[start - 1, stop]] = False
    return see_ends(motion, missing, start, stop)


@each_length
def test_untaught_it_interpolates_places_evenly(frames):
    motion = walk(60, turn_rate=0.6)
    ends = bare(motion, 11, 10 + frames)
    joined = tiny_stitcher(drawn=0.0).answer(ends, frames)
    share = torch.arange(1, frames)[:, None] / frames
    assert joined.root_position.shape == (1, frames - 1, 3)
    heights = motion.root_position[[10, 10 + frames], 1].float()
    torch.testing.assert_close(joined.root_position[0, :, 1], torch.lerp(*heights, share[:, 0]), atol=1e-5, rtol=0)
    assert float(joined.apart.max()) < 1e-3


def test_only_the_poses_of_bare_ends_are_seen():
    motion = walk(60, turn_rate=0.6)
    missing = torch.ones(60, dtype=torch.bool)
    missing[[10, 30]] = False
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    root[missing] += torch.tensor([0.5, 0.2, -0.7]).double()
    quats[missing] = quats[missing].flip(0)
    other = replace(motion, root_position=root, local_quat_xyzw=quats)
    one, two = (tiny_stitcher().answer(see_ends(each, missing, 11, 30), 20) for each in (motion, other))
    assert torch.equal(one.root_position, two.root_position)
    assert torch.equal(one.quats, two.quats)


def test_a_draw_is_that_of_its_seed_and_number():
    ends = bare(walk(60), 11, 30)
    seeds = [(3, 0), (3, 9), (3, 17), (4, 0)]
    one, again = ([tiny_stitcher().drawing(*each).draw(ends, 11, 20, each[0]).quats for each in seeds] for _ in (1, 2))
    assert all(map(torch.equal, one, again))
    assert all(float((one[0] - other).abs().max()) > 1e-4 for other in one[1:])


def test_an_answer_that_is_not_finite_is_left_to_another():
    broken = tiny_stitcher()
    broken.network.experts.shrink_last(float("nan"))
    source = broken.propose(query_of(walk(60), (20, 40))).others[0]
    assert (source.by, source.reason) == ("interpolation", "nothing finite came of it")


def never():
    raise AssertionError("nothing was left to the other")


def stitched(load=never):
    return StitchedInbetweener(tiny_stitcher(), load)


def test_gaps_that_are_too_long_or_have_one_end_are_the_others_and_the_rest_stays_stitched():
    query = query_of(walk(90), (10, 25), (40, 70), (80, 90))
    result, alone = stitched(SlerpInbetweener).propose(query), tiny_stitcher().propose(query)
    assert torch.equal(result.motion.local_quat_xyzw[10:25], alone.motion.local_quat_xyzw[10:25])
    slerp = SlerpInbetweener().propose(query).motion
    assert torch.equal(result.motion.local_quat_xyzw[40:], slerp.local_quat_xyzw[40:])
    first, second, third = result.attribute(query)
    assert (first.by, first.reason) == ("stitcher", "")
    assert (second.by, second.reason) == ("slerp", "longer than the 23 frames that the stitcher fills")
    assert (third.by, third.start, third.stop) == ("slerp", 80, 90)
    assert third.reason.startswith("known in part or on one side alone")


def test_what_was_stitched_is_reported():
    done = tween(walk(60), Keys.of([0, 20, 59]), stitched(SlerpInbetweener), refinement=None)
    given = done.details()
    assert 0 <= given["sides_apart_cm"] < 100
    assert [(row["by"], row["start"], row["stop"]) for row in given["fallback"]] == [("slerp", 21, 59)]
    assert given["timing"]["draw_ms"] > 0
    assert given["timing"]["finish_ms"] > 0


GAP = slice(21, 40)


@pytest.mark.slow
def test_hip_keys_alone_are_met():
    motion = walk(60, turn_rate=0.5)
    done = tween(motion, Keys.of([20, 28, 40], root_only=True), StitchedInbetweener(tiny_stitcher(), SlerpInbetweener))
    torch.testing.assert_close(done.motion.root_position[28], motion.root_position[28], atol=1e-6, rtol=0)
    inner = [(source.start, source.stop, source.by) for source in done.sources if 20 < source.start < 40]
    assert inner == [(21, 40, "stitcher")]
    steps = torch.diff(done.motion.joint_positions()[20:41], dim=0).norm(dim=-1)
    assert float(steps.max()) < 0.25  # nothing leaps


def test_a_gap_along_a_trajectory_is_the_others():
    query = replace(query_of(walk(60), (GAP.start, GAP.stop)), keep_trajectory=True)
    (source,) = stitched(SlerpInbetweener).propose(query).attribute(query)
    assert (source.by, source.reason) == ("slerp", "along a trajectory, which it does not take")
