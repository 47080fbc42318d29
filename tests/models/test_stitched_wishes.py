"""Stitched gaps in which more is told than the poses beside them: hands, feet, hips, a trajectory."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import walk
from scipy.optimize import least_squares
from test_stitcher import query_of
from tiny_stitcher import tiny_stitcher

from controllers.inbetweening.pipeline import InfillSettings, fill
from controllers.inbetweening.proposers import SlerpInbetweener, StitchedInbetweener
from controllers.inbetweening.tween import tween
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Keys
from priors.stitcher import Joined, fit_shared

RAW = InfillSettings(finish=False)
GAP = slice(21, 40)


def never():
    raise AssertionError("nothing was left to the other")


def wishing(motion, frame, limb, offset):
    """A query that wants a limb elsewhere in a frame."""
    joint = motion.skeleton.index(limb)
    places = motion.joint_positions().clone()
    places[frame, joint] += torch.tensor(offset).double()
    wanted = torch.zeros(places.shape[:2], dtype=torch.bool)
    wanted[frame, joint] = True
    return replace(query_of(motion, (GAP.start, GAP.stop)), effector_targets=EffectorTargets(places, wanted))


def miss(query, motion):
    targets = query.effector_targets
    return float((motion.joint_positions() - targets.places).norm(dim=-1)[targets.wanted].max())


@pytest.mark.parametrize("spread", [0.7, 1.5])
def test_the_fit_is_that_of_least_squares(spread):
    """On a map that bends a little, beside scipy's: both minimise residuals and the distance from the centre."""
    draw = np.random.default_rng(1)
    matrix, wish, centre = draw.normal(size=(5, 4)), draw.normal(size=5), draw.normal(size=4)

    def residuals(codes):
        bent = codes @ matrix.T
        return bent + 0.05 * np.sin(bent) - 3 * wish

    def make(codes):  # motions whose hips go where the codes say
        root = torch.nn.functional.pad(codes[..., None], (0, 2)).float()
        return Joined(root, torch.zeros(len(codes), 4, 21, 4), torch.zeros(len(codes), 4, 2), torch.zeros(len(codes)))

    def read(made):
        return made.root_position[..., 0].double().numpy()

    def measure(made):
        return torch.as_tensor(residuals(read(made))).float()

    def energy(codes):
        return np.square(residuals(codes)).sum() + np.square((codes - centre) / spread).sum()

    found = read(fit_shared(make, measure, torch.as_tensor(centre).float(), spread))[0]
    best = least_squares(lambda codes: np.concatenate([residuals(codes), (codes - centre) / spread]), centre).x
    assert energy(found) < 0.8 * energy(centre)
    assert energy(found) == pytest.approx(energy(best), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("limb", ["leftHand", "rightFoot"])
def test_what_is_wanted_leads_the_answer(limb):
    query = wishing(walk(60), 30, limb, (0.2, 0.25, 0.1))
    plain = tiny_stitcher().propose(replace(query, effector_targets=None))
    led = tiny_stitcher().propose(query)
    assert miss(query, led.motion) < miss(query, plain.motion) - 0.001
    ends = [GAP.start - 1, GAP.stop]
    assert torch.equal(led.motion.local_quat_xyzw[ends], query.motion.local_quat_xyzw[ends])
    assert f"{100 * miss(query, led.motion):.1f} cm off unbent" in led.attribute(query)[0].remark


@pytest.mark.slow
def test_then_limbs_and_the_body_bend_until_it_is_met():
    query = wishing(walk(60), 30, "leftHand", (0.1, 0.3, 0.2))
    done = fill(
        query.motion,
        MissingMask.of_frames(query.missing.frames, 21),
        StitchedInbetweener(tiny_stitcher(), never),
        settings=RAW,
        targets=query.effector_targets,
    )
    assert miss(query, done.motion) < 1e-3
    assert [source.by for source in done.sources] == ["stitcher"]


@pytest.mark.slow
def test_a_taller_character_is_led_as_one_of_unit_size():
    query, size = wishing(walk(60), 30, "leftHand", (0.2, 0.25, 0.1)), 1.3
    motion, targets = query.motion, query.effector_targets
    bones = replace(motion.skeleton, offsets=size * motion.skeleton.offsets)
    tall = replace(
        query,
        motion=replace(motion, skeleton=bones, root_position=size * motion.root_position),
        effector_targets=EffectorTargets(size * targets.places, targets.wanted),
    )
    one, other = (tiny_stitcher().propose(each).motion.joint_positions() for each in (query, tall))
    assert float((size * one - other).abs().max()) < 1e-4


@pytest.mark.slow
def test_hips_that_are_told_alone_are_met_and_divide_the_gap():
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
        made = StitchedInbetweener(tiny_stitcher(), SlerpInbetweener).propose(led)
        assert [source.by for source in made.attribute(led)] == [by]
        assert float((made.motion.root_position - root)[GAP, ::2].norm(dim=-1).mean()) < 0.03
    (source,) = made.attribute(led)
    assert "off the trajectory" in source.reason
