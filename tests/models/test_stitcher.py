"""The stitcher: both ends exact, draws, constraints within a gap, and who fills what cannot be stitched."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import walk
from scipy.optimize import least_squares
from tiny_stitcher import tiny_stitcher

from controllers.inbetweening.pipeline import CanonicalClip
from controllers.inbetweening.proposers import SlerpInbetweener, StitchedInbetweener
from controllers.inbetweening.tween import tween
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.intent.keyframes import Keys
from mapctl.recording.masks import ALL, Mask, MissingMask
from mapctl.retarget import to_canonical
from priors.stitcher import Joined, fit_shared, see_ends

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


def test_draws_are_the_same_in_any_order_and_differ():
    ends = bare(walk(60), 11, 30)
    first, other = (tiny_stitcher().drawing(3) for _ in range(2))
    found = {number: first.draw(ends, 11, 20, number) for number in (0, 9, 17)}
    again = {number: other.draw(ends, 11, 20, number) for number in (17, 9, 0)}
    assert all(torch.equal(found[number].quats, again[number].quats) for number in found)
    assert float((found[0].quats - found[9].quats).abs().max()) > 1e-4


def test_draws_that_are_not_finite_are_dropped():
    drawing, ends = tiny_stitcher().drawing(0), bare(walk(60), 11, 30)
    fourth = drawing.draw(ends, 11, 20, 4)
    (chunk,) = drawing.chunks.values()
    chunk.root_position[[2, 3]] = torch.nan
    assert torch.equal(drawing.draw(ends, 11, 20, 2).quats, fourth.quats)
    assert torch.equal(drawing.draw(ends, 11, 20, 1).quats, chunk.quats[1:2])
    chunk.root_position[:] = torch.nan
    assert drawing.draw(ends, 11, 20, 0) is None


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


def query_with_target(motion, frame, limb, offset):
    """A query that wants a limb elsewhere in a frame."""
    joint = motion.skeleton.index(limb)
    positions = motion.joint_positions().clone()
    positions[frame, joint] += torch.tensor(offset).double()
    wanted = torch.zeros(positions.shape[:2], dtype=torch.bool)
    wanted[frame, joint] = True
    return replace(query_of(motion, (GAP.start, GAP.stop)), effector_targets=EffectorTargets(positions, wanted))


def miss(query, motion):
    targets = query.effector_targets
    return float((motion.joint_positions() - targets.positions).norm(dim=-1)[targets.wanted].max())


@pytest.mark.parametrize("spread", [0.7, 1.5])
def test_the_fit_is_that_of_least_squares(spread):
    """On a map that bends a little, beside scipy's: both minimise residuals and the distance from the centre."""
    draw = np.random.default_rng(1)
    matrix, target, centre = draw.normal(size=(5, 4)), draw.normal(size=5), draw.normal(size=4)

    def residuals(codes):
        bent = codes @ matrix.T
        return bent + 0.05 * np.sin(bent) - 3 * target

    def make(codes):  # motions whose hips go where the codes say
        root = torch.nn.functional.pad(codes[..., None], (0, 2)).float()
        return Joined(root, torch.zeros(len(codes), 4, 21, 4), torch.zeros(len(codes), 4, 2), torch.zeros(len(codes)))

    def read(result):
        return result.root_position[..., 0].double().numpy()

    def measure(result):
        return torch.as_tensor(residuals(read(result))).float()

    def energy(codes):
        return np.square(residuals(codes)).sum() + np.square((codes - centre) / spread).sum()

    found = read(fit_shared(make, measure, torch.as_tensor(centre).float(), spread))[0]
    best = least_squares(lambda codes: np.concatenate([residuals(codes), (codes - centre) / spread]), centre).x
    assert energy(found) < 0.8 * energy(centre)
    assert energy(found) == pytest.approx(energy(best), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("limb", ["leftHand", "rightFoot"])
def test_what_is_wanted_leads_the_answer(limb):
    query = query_with_target(walk(60), 30, limb, (0.2, 0.25, 0.1))
    plain = tiny_stitcher().propose(replace(query, effector_targets=None))
    led = tiny_stitcher().propose(query)
    assert miss(query, led.motion) < miss(query, plain.motion) - 0.001
    ends = [GAP.start - 1, GAP.stop]
    assert torch.equal(led.motion.local_quat_xyzw[ends], query.motion.local_quat_xyzw[ends])
    assert f"{100 * miss(query, led.motion):.1f} cm off unbent" in led.attribute(query)[0].remark


@pytest.mark.slow
def test_hip_keys_alone_are_met_and_divide_the_gap():
    motion = walk(60, turn_rate=0.5)
    done = tween(motion, Keys.of([20, 28, 40], root_only=True), StitchedInbetweener(tiny_stitcher(), SlerpInbetweener))
    torch.testing.assert_close(done.motion.root_position[28], motion.root_position[28], atol=1e-6, rtol=0)
    inner = [(source.start, source.stop, source.by) for source in done.sources if 20 < source.start < 40]
    assert inner == [(21, 28, "stitcher"), (29, 40, "stitcher")]
    steps = torch.diff(done.motion.joint_positions()[20:41], dim=0).norm(dim=-1)
    assert float(steps.max()) < 0.25  # nothing leaps


@pytest.mark.slow
def test_a_trajectory_is_followed_and_one_that_is_far_is_the_others():
    query = query_of(walk(60), (GAP.start, GAP.stop))
    bow = 0.15 * torch.sin(torch.linspace(0, torch.pi, GAP.stop - GAP.start + 2)[1:-1]).double()
    for scale, by in ((1.0, "stitcher"), (8.0, "slerp")):
        root = query.motion.root_position.clone()
        root[GAP, 0] += scale * bow
        led = replace(query, motion=replace(query.motion, root_position=root), keep_trajectory=True)
        result = StitchedInbetweener(tiny_stitcher(), SlerpInbetweener).propose(led)
        assert [source.by for source in result.attribute(led)] == [by]
        assert float((result.motion.root_position - root)[GAP, ::2].norm(dim=-1).mean()) < 0.03
    (source,) = result.attribute(led)
    assert "off the trajectory" in source.reason
