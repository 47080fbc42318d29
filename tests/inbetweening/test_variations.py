"""`mapctl tween --variations K`: several motions through the same keys, all of which meet them."""

import math
from dataclasses import replace

import pytest
import torch
from captures import on_rig
from helpers import generator, tiny_density
from methods import UNFINISHED
from tiny_infiller import tiny_infiller
from tiny_prior import save_tiny_prior

import priors
from controllers.inbetweening.infill import infill
from controllers.inbetweening.pipeline import INFILL_REFINEMENT, CanonicalClip, InfillSettings
from controllers.inbetweening.proposers import AutoInbetweener, RolloutInbetweener, RolloutSettings, SlerpInbetweener
from controllers.inbetweening.tween import tween
from controllers.inbetweening.variations import sample_variations
from mapctl.errors import RequestError
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Keys
from mapctl.problem.window_solvers import LatentNoiseSolver, SwarmProposal
from mapctl.recording.masks import Mask
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings

FRAMES, KEYS = 45, (0, 20, 23, 44)
FEW_FRAMES, FEW_KEYS = 25, (0, 10, 13, 24)
FEW = InfillSettings(refinement=replace(INFILL_REFINEMENT, budget=Budget(evaluations=4)))
QUICK = RolloutSettings(
    ahead=4,
    jump=math.inf,  # a small density of drawn weights does nothing else
    method=LatentNoiseSolver(
        rounds=1,
        lbfgs=LbfgsSettings(max_iterations=4),
        budget=Budget(evaluations=10),
        proposal=SwarmProposal(SwarmSettings(particles=4, iterations=1)),
    ),
)


@pytest.fixture(scope="module")
def prior_file(tmp_path_factory):
    return save_tiny_prior(tmp_path_factory.mktemp("prior") / "tiny.safetensors")


@pytest.fixture(scope="module")
def prior(prior_file):
    return priors.load(str(prior_file))


INFILLER = tiny_infiller(drawn=0.02)


def making(motion, keys):
    """Tweens of one motion by whoever is asked."""
    return lambda inbetweener, draws: tween(motion, keys, inbetweener, settings=FEW, generator=draws)


def asked(motion, prior, *, count=3, seed=0, keys=KEYS, rolling=QUICK, **given):
    make, rollouts = making(motion, Keys.of(keys, **given)), RolloutInbetweener([prior], INFILLER, rolling)
    first = AutoInbetweener(INFILLER, [prior])
    refinement = FEW.refinement
    return sample_variations(make, first, rollouts, count, generator=generator(seed), refinement=refinement)


@pytest.mark.parametrize(("rig", "fps"), [("canonical", 30), pytest.param("daz", 60, marks=pytest.mark.slow)])
def test_every_variation_meets_the_keys_to_the_bit_and_no_two_are_the_same(prior, rig, fps):
    motion = on_rig(rig, FEW_FRAMES * fps // 30, fps=fps)
    keys = [key * fps // 30 for key in FEW_KEYS]
    found = asked(motion, prior, keys=tuple(keys))
    positions = [one.solution.motion.joint_positions() for one in found.each]
    for one in found.each:
        result = one.solution.motion
        assert torch.equal(result.local_quat_xyzw[keys], motion.local_quat_xyzw[keys])
        assert torch.equal(result.root_position[keys], motion.root_position[keys])
    apart = [float((positions[i] - positions[j]).norm(dim=-1).max()) for i in range(3) for j in range(i)]
    assert min(apart) > 0.002  # gaps are a third of a second
    assert found.diversity.world_cm > 0.1
    assert all(torch.isfinite(torch.tensor(one.energy)) for one in found.each)


def test_a_rollout_changes_nothing_that_is_known_or_has_no_end():
    motion = on_rig("canonical", FRAMES)
    free = torch.zeros(FRAMES, dtype=torch.bool)
    free[:5] = free[20:30] = free[40:] = True
    missing = MissingMask(free[:, None].expand(-1, motion.num_joints).clone(), free)
    gap = CanonicalClip.of(motion, missing).query()
    logits = SlerpInbetweener().propose(gap).contact_logits
    answer = RolloutInbetweener([tiny_density()], SlerpInbetweener(), QUICK).propose(gap, generator=generator(0))
    result, bits = answer.motion, answer.contact_logits
    assert [(source.start, source.stop) for source in answer.attribute(gap)] == [(20, 30)]
    same = torch.ones(FRAMES, dtype=torch.bool)
    same[20:30] = False
    torch.testing.assert_close(result.root_position[same], gap.motion.root_position[same])
    torch.testing.assert_close(result.local_quat_xyzw[same], gap.motion.local_quat_xyzw[same])
    assert torch.equal(bits[same], logits[same])
    assert float((result.root_position - gap.motion.root_position)[20:30].norm(dim=-1).max()) > 1e-4


def test_a_gap_in_which_every_rollout_jumps_is_left_to_the_fallback():
    motion = on_rig("canonical", FRAMES)
    free = torch.zeros(FRAMES, dtype=torch.bool)
    free[20:30] = True
    gap = CanonicalClip.of(motion, MissingMask.of_frames(free, motion.num_joints)).query()
    jumping = replace(QUICK, jump=0.0, least_jump=0.0)
    answer = RolloutInbetweener([tiny_density()], SlerpInbetweener(), jumping).propose(gap, generator=generator(0))
    (source,) = answer.attribute(gap)
    assert (source.by, source.reason) == ("slerp", "every rollout jumped")
    plain = SlerpInbetweener().propose(gap).motion.local_quat_xyzw
    torch.testing.assert_close(answer.motion.local_quat_xyzw, plain)


@pytest.mark.parametrize("frames", [(30, 45), pytest.param((8, 45), marks=pytest.mark.slow)])
def test_an_end_is_extended_by_a_density_and_a_beginning_never(prior, frames):
    motion, masks = on_rig("bandai", FRAMES), [Mask("*", 0, 2), Mask("*", *frames)]
    plain, result, again = (
        infill(motion, inbetweener, masks, settings=UNFINISHED)
        for inbetweener in (INFILLER, *[AutoInbetweener(INFILLER, [prior])] * 2)
    )
    known = ~result.missing.frames
    for one in (plain, result):
        assert torch.equal(one.motion.local_quat_xyzw[known], motion.local_quat_xyzw[known])
        assert bool(one.motion.joint_positions().isfinite().all())
    apart = (result.motion.joint_positions() - plain.motion.joint_positions()).norm(dim=-1).amax(dim=-1)
    assert float(apart[:2].max()) < 1e-3
    assert float(apart[frames[0] + 3 :].min()) > 1e-4
    assert [note.split(",")[0].rpartition("extended ")[2] for note in result.notes] == [
        "backwards by infiller",
        f"by density {prior.name}",
    ]
    assert plain.notes[1].split(",")[0].endswith("extended by infiller")
    assert torch.equal(again.motion.local_quat_xyzw, result.motion.local_quat_xyzw)


@pytest.mark.slow
def test_what_leaves_nothing_to_vary_is_refused(prior):
    motion = on_rig("canonical", FRAMES)
    with pytest.raises(RequestError, match="nothing to vary"):
        asked(motion, prior, keys=tuple(range(FRAMES)))
    with pytest.raises(RequestError, match="leaves nothing to vary"):
        asked(motion.slice(0, 6), prior, keys=(0, 5))
    with pytest.raises(RequestError, match="every rollout jumped between these keys, which leaves nothing to vary"):
        asked(motion, prior, rolling=replace(QUICK, jump=0.0, least_jump=0.0))
    for count in (1, 1001):
        with pytest.raises(RequestError, match=f"variations are 2 to 1000, got {count}"):
            asked(motion, prior, count=count)
