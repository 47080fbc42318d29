"""Who fills a gap: the infiller where it knows enough, nobody where one stands, else whoever slides least."""

from dataclasses import replace

import pytest
import torch
from helpers import tiny_density, walk
from tiny_infiller import tiny_infiller

from controllers.common.canonical_clip import CanonicalClip
from controllers.inbetweening.error_estimates import estimate_error
from controllers.inbetweening.geometry.footholds import hold_planted
from controllers.inbetweening.proposers.auto import (
    STANDING_STILL,
    AutoInbetweener,
    ChoiceSettings,
    compute_artefact_cost,
)
from controllers.inbetweening.proposers.rollouts import RolloutSettings
from controllers.inbetweening.tween import tween
from mapctl import contacts
from mapctl.inbetweening import Proposal
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import Keys
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings

TOES = [CANONICAL.index(name) for name in ("leftToes", "rightToes")]
QUICK = ChoiceSettings(
    tempos=(1.0, 0.9),
    rolling=RolloutSettings(
        temperature=0.0,
        trajectory=0.2,
        stage=30,
        ahead=4,
        method=LatentNoiseSolver(rounds=1, lbfgs=LbfgsSettings(max_iterations=3), budget=Budget(evaluations=6)),
    ),
)


class Lines(Inbetweener):
    """Stands for the infiller: straight lines."""

    def propose(self, query, *, generator=None):
        return Proposal(query.motion, torch.zeros(query.motion.num_frames, 2), "infiller")


def chosen(motion, start, stop, *, densities=(), settings=QUICK):
    """The query of a motion that lacks frames, and what is proposed for it."""
    free = torch.zeros(motion.num_frames, dtype=torch.bool)
    free[start:stop] = True
    query = CanonicalClip.of(motion, MissingMask(free[:, None].expand(-1, motion.num_joints).clone(), free)).query()
    return query, AutoInbetweener(Lines(), densities, settings).propose(query)


def still(frames):
    motion = walk(2)
    first = torch.zeros(frames, dtype=torch.long)
    return replace(motion, root_position=motion.root_position[first], local_quat_xyzw=motion.local_quat_xyzw[first])


@pytest.mark.parametrize(
    ("start", "stop", "asked"),
    [(1, 31, False), (1, 33, True), (20, 78, False), pytest.param(20, 82, True, marks=pytest.mark.slow)],
)
def test_the_infiller_is_asked_alone_for_what_it_knows(start, stop, asked):
    """Up to a second between bare poses, two between known motion."""
    query, answer = chosen(walk(stop + (20 if start > 1 else 1)), start, stop, densities=[tiny_density()])
    (source,) = answer.attribute(query)
    assert (source.start, source.stop) == (start, stop)
    assert (source.by == "infiller") or asked


@pytest.mark.parametrize("seconds", [2, 4, 8])
def test_somebody_who_stands_stays_where_he_is(seconds):
    motion = still(30 * seconds + 1)
    wandering = tiny_infiller(drawn=0.05)
    done = tween(motion, Keys((0, 30 * seconds)), AutoInbetweener(wandering, [tiny_density()]))
    assert [source.by for source in done.sources] == [STANDING_STILL]
    away = (done.motion.root_position - motion.root_position).norm(dim=-1)
    assert away.max() < 0.02
    assert any("standing still" in note for note in done.gap_notes)


def test_somebody_who_is_on_the_move_beside_a_gap_does_not_just_stand():
    """The same pose before and after, but hands that are in full swing."""
    motion = walk(120, cadence=1.0)
    period = 30
    motion = replace(motion, root_position=motion.root_position * torch.tensor([0.0, 1.0, 0.0]).double())
    start, stop = 20, 20 + 3 * period - 1
    query, answer = chosen(motion, start, stop)
    assert answer.attribute(query)[0].by == "infiller"


def test_a_slide_costs_what_a_viewer_sees_and_a_walk_does_not():
    motion = walk(90)
    odds = torch.full((90, 2), -1.0)
    sliding = replace(still(90), root_position=motion.root_position)
    walks, slides = (compute_artefact_cost(each, odds, (1, 89), QUICK) for each in (motion, sliding))
    assert slides > walks + 0.3
    round_about = motion.root_position.clone()
    round_about[:, 0] += torch.sin(torch.arange(90) / 89 * torch.pi) * 1.5
    assert compute_artefact_cost(replace(motion, root_position=round_about), odds, (1, 89), QUICK) > walks


def test_of_several_answers_the_one_that_costs_least_is_taken():
    motion = walk(45)
    costs = {}
    for name, settings in (("rolled", QUICK), ("alone", replace(QUICK, acceptable_cost=1e9))):
        _, answer = chosen(motion, 1, 44, densities=[tiny_density()], settings=settings)
        costs[name] = compute_artefact_cost(answer.motion, answer.contact_logits, (1, 44), QUICK)
    assert costs["rolled"] <= costs["alone"] + 1e-9


def test_known_frames_stay_and_the_same_comes_twice():
    motion, one_tempo = walk(35), replace(QUICK, tempos=(1.0,))
    answers = [chosen(motion, 1, 34, densities=[tiny_density()], settings=one_tempo)[1] for _ in range(2)]
    assert torch.equal(answers[0].motion.local_quat_xyzw, answers[1].motion.local_quat_xyzw)
    for frame in (0, 34):
        torch.testing.assert_close(answers[0].motion.joint_positions()[frame], motion.joint_positions()[frame])


def test_planted_toes_are_held_and_what_is_known_stays():
    """A walk that slides aside: toes stand where they first stood, or in the middle of where they slid."""
    motion = walk(60)
    stands = contacts.detect_contacts(motion.joint_positions()[:, TOES], 30)
    sliding = torch.arange(60).double()[:, None] * torch.tensor([0.006, 0.0, 0.0]).double()
    motion = replace(motion, root_position=motion.root_position + sliding)
    free = torch.ones(60, dtype=torch.bool)
    free[:12] = False
    made = hold_planted(motion, stands, free=free, rest_height=0.0425)
    speeds = [each.joint_positions()[:, TOES].diff(dim=0).norm(dim=-1) for each in (motion, made)]
    held = (stands[1:] & stands[:-1])[12:]
    assert speeds[0][12:][held].mean() > 0.005
    assert speeds[1][12:][held].mean() < 0.002  # where legs are stretched, toes go along a little
    assert torch.equal(made.local_quat_xyzw[:12], motion.local_quat_xyzw[:12])
    assert torch.equal(made.root_position, motion.root_position)


def test_a_long_morph_of_somebody_who_moves_is_called_one():
    motion = walk(100)
    done = tween(motion, Keys((0, 99)), AutoInbetweener(tiny_infiller()))  # straight lines
    (note,) = done.gap_notes
    assert "a still morph" in note
    assert "longer than the" in note


def test_what_was_never_measured_is_not_called_sure():
    for by in ("slerp", "infiller", STANDING_STILL):
        assert estimate_error(by, 30, travelling=True, in_context=True) is None
    assert estimate_error("rollout of locomotion", 30, travelling=False, in_context=True) is None


@pytest.mark.parametrize("by", ["rollout of locomotion", "density general"])
@pytest.mark.parametrize(("going", "beside"), [(True, True), (True, False), (False, False)])
def test_longer_gaps_are_no_surer_and_what_few_clips_told_is_said(by, going, beside):
    sures = [estimate_error(by, frames, travelling=going, in_context=beside) for frames in (5, 15, 60, 200, 1000)]
    assert sures[0].percentile_90_cm <= sures[-1].percentile_90_cm
    assert sures[-2] == sures[-1]
    for sure in sures:
        assert sure.median_cm <= sure.percentile_90_cm
        assert ("only" in sure.text) == (sure.clips < 5)
