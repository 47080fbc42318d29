"""Shots: parts on their own, and one short shot by the bundled models, measured where a viewer looks."""

import math
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers import generator, walk

import controllers
import priors
from controllers.common.character import Character
from controllers.shots.constraints import check_walk
from controllers.shots.reaching import build_rest_pose, measure_look_errors, turn_heads
from controllers.shots.request import Lead, Look, Others, Reach, ShotRequest
from controllers.shots.seams import compute_artefact_cost
from controllers.shots.shot import solve_shot
from controllers.shots.trajectory import StandingEnds, Trajectory, lay_timeline, plan_speeds, plan_trajectory
from mapctl import curves, kinematics, rotations
from mapctl.commands.shared.shots import ShotPlan, let_others_pass
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.errors import RequestError
from mapctl.intent.path import SpeedProfile, TimedSpeed
from mapctl.metrics import body
from mapctl.metrics.body import measure_peaks
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES
from scenes.scene_file import Actor

LINE = curves.line(length=3)
STANDING = StandingEnds(start=True, end=True)


# What is done when


def test_a_walk_too_short_to_be_one_is_stepped():
    speeds = torch.tensor([0.9] * 10 + [0.0] * 40, dtype=torch.float64)
    for each, wanted in ((speeds, [(0, 1), (10, 50)]), (speeds.flip(0), [(0, 40), (49, 50)])):
        spans = lay_timeline(each, slowest=0.5)
        assert [(span.what, span.start, span.stop) for span in spans] == [("stand", *frames) for frames in wanted]


def test_a_character_stands_walks_and_stands_again():
    speeds = TimedSpeed.parse(((0, 0), (1, 0), (2, 1.2), (5, 1.2), (6, 0), (7, 0), (8, 1.0))).at(270, 30)
    spans = lay_timeline(speeds, slowest=0.5)
    assert [span.what for span in spans] == ["stand", "walk", "stand", "walk"]
    for span in spans:
        part = speeds[span.start : span.stop]
        assert bool((part < 0.05).all()) if span.what == "stand" else float(part.min()) > 0.6
    assert all(one.stop <= other.start for one, other in pairwise(spans))
    assert (spans[0].start, spans[-1].stop) == (0, 270)


def test_what_is_too_short_for_a_walk_is_a_step_between_two_standings():
    speeds = torch.zeros(120)
    speeds[50:60] = 0.8
    assert [span.what for span in lay_timeline(speeds, slowest=0.5)] == ["stand", "stand"]


@pytest.mark.parametrize("seconds", [None, 6.0])
def test_speeds_rise_from_standing_and_end_at_the_curves_end(seconds):
    speeds = plan_speeds(SpeedProfile.constant(1.2), 3.0, 30, STANDING, seconds=seconds, most=10_000)
    assert float(speeds.sum()) / 30 == pytest.approx(3.0, abs=0.06)
    assert float(speeds.diff().abs().max()) * 30 < 5  # no lurch
    assert bool((speeds[:15] == 0).all())
    assert bool((speeds[-29:] < 0.05).all())
    assert float(speeds.max()) == pytest.approx(1.2, abs=0.05)
    if seconds is not None:
        assert len(speeds) == round(30 * seconds)


# Where


def test_a_route_past_an_oncoming_walker_keeps_apart_when_they_meet():
    seconds = 5.0
    towards = torch.stack([torch.full((150,), 0.1), 6 - 1.2 * torch.arange(150) / 30], -1).double()
    request = ShotRequest(curves.line(length=6), seconds=seconds, others=Others(towards[None], 0.6))
    trajectory = plan_trajectory(request)
    assert trajectory.note is None
    there = trajectory.curve.point(trajectory.arcs)
    assert float((there - towards[: len(there)]).norm(dim=-1).min()) > 0.6
    alone = plan_trajectory(replace(request, others=None))
    assert float((alone.curve.point(alone.arcs) - towards[: len(alone.arcs)]).norm(dim=-1).min()) < 0.2


# Invalid requests


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": TimedSpeed((0.0,), (1.0,))}, "need the shot's seconds"),
        ({"obstacles": (Obstacle((0.1, 0.0), 0.5),)}, "the start is within the obstacle"),
        ({"seconds": 2.0, "reaches": (Reach(1.9, {"leftHand": (0, 1, 1)}, 0.3),)}, "not within the shot's 2 s"),
        (
            {"reaches": (Reach(1.0, {"leftHand": (0.3, 1, 1)}), Reach(1.05, {"leftHand": (0.3, 1.4, 1)}))},
            "two positions 40 cm apart within two frames",
        ),
        ({"seconds": 2.0, "looks": (Look(2.5, (0, 1, 1)),)}, "not within the shot's 2 s"),
    ],
)
def test_wishes_that_make_no_sense_are_refused(options, message):
    with pytest.raises(RequestError, match=message):
        ShotRequest(LINE, **options)


@pytest.mark.parametrize(
    "position", [(0.3, 2.6, 1.0), (2.6, 1.2, 1.2), (0.0, 1.2, 12.0)], ids=["high", "aside", "ahead"]
)
def test_what_no_arm_reaches_is_refused_with_its_distance(position):
    request = ShotRequest(LINE, seconds=2.0, reaches=(Reach(1.0, {"leftHand": position}),))
    with pytest.raises(RequestError, match=r"leftHand at 1 s is to be \d"):
        solve_shot(priors.load("locomotion"), priors.load_inbetweener(), request)


# Going on from a clip


def test_a_curve_is_brought_to_a_lead_or_the_lead_to_the_curve():
    lead = Lead.of(walk(90, turn_rate=0.5), 80)
    brought = lead.bring_curve(curves.wave(amplitude=0.5, length=4))
    torch.testing.assert_close(brought.start, lead.motion.root_position[-1, ::2])
    assert abs(math.remainder(brought.start_heading - lead.direction, 2 * math.pi)) < 0.02
    curve = curves.circle(radius=3)
    moved = lead.bring_to(curve)
    torch.testing.assert_close(moved.motion.root_position[-1, ::2], curve.start)
    assert abs(math.remainder(moved.direction - curve.start_heading, 2 * math.pi)) < 1e-6
    steps = [each.motion.root_position.diff(dim=0).norm(dim=-1) for each in (lead, moved)]
    torch.testing.assert_close(*steps)


# Poses


def test_the_rest_pose_stands_on_both_feet_and_faces_forward():
    pose = build_rest_pose(priors.load("locomotion"), CANONICAL, TOE_REST_HEIGHT)
    positions = pose.joint_positions()[0]
    toes = positions[list(CANONICAL.indices(TOES))]
    torch.testing.assert_close(toes[:, 1], torch.full((2,), TOE_REST_HEIGHT).double(), atol=1e-3, rtol=0)
    assert 0.12 < float((toes[0] - toes[1]).norm()) < 0.4
    assert float(positions[CANONICAL.index("head"), 1]) > 1.3
    hands = positions[list(CANONICAL.indices(("leftHand", "rightHand")))]
    assert bool((hands[:, 1] < 1.0).all())
    assert float(hands[0, 0]) == pytest.approx(-float(hands[1, 0]), abs=1e-6)


def test_a_head_looks_at_its_target_and_back_without_a_jump():
    motion = walk(120)
    look = Look(2.0, (3.0, 1.4, 4.0), 0.5)
    turned = turn_heads(motion, (look,))
    assert float(measure_look_errors(turned, look).max()) < 5 < float(measure_look_errors(motion, look).min())
    head = CANONICAL.index("head")
    same = torch.tensor([*range(44), *range(92, 120)])
    torch.testing.assert_close(turned.joint_rotations()[same, head], motion.joint_rotations()[same, head])
    one, other = turned.joint_rotations()[:-1, head], turned.joint_rotations()[1:, head]
    assert float(torch.rad2deg(2 * (one * other).sum(-1).abs().clamp(max=1).acos()).max()) < 12  # a frame


# All at once


@pytest.fixture(scope="module")
def shot():
    prior = priors.load("locomotion")
    prior.warm_up()
    request = ShotRequest(
        curves.line(length=3.6),
        stand_at_start=True,
        stand_at_end=True,
        obstacles=(Obstacle((0.35, 2.4), 0.3),),
        reaches=(Reach(2.3, {"rightHand": (-0.45, 1.2, 1.5)}),),
        looks=(Look(3.5, (2.0, 1.5, 4.0)),),
    )
    return request, solve_shot(prior, priors.load_inbetweener(), request, generator=torch.Generator().manual_seed(1))


def test_all_constraints_of_a_shot_hold(shot):
    _, done = shot
    assert done.status.ok, done.status.text
    assert {constraint.name.split(" at")[0] for constraint in done.constraints} >= {
        "path",
        "rightHand",
        "look",
        "obstacles",
        "stand",
    }
    assert all(constraint.holds and constraint.residual == 0 for constraint in done.constraints)


def test_the_motion_of_a_shot_does_what_its_wishes_say(shot):
    request, done = shot
    positions = done.motion.joint_positions()
    miss = positions[69, CANONICAL.index("rightHand")] - torch.tensor([-0.45, 1.2, 1.5]).double()
    assert float(miss.norm()) < 0.01
    assert float(measure_clearance(request.obstacles, positions[..., ::2]).amin()) > 0
    toes = positions[:, list(CANONICAL.indices(TOES))]
    for part in (slice(0, 12), slice(-24, None)):
        assert float(toes[part].diff(dim=0).norm(dim=-1).mean()) * 30 < 0.02
        assert float((toes[part][:, 0] - toes[part][:, 1]).norm(dim=-1).max()) < 0.45
    torch.testing.assert_close(positions[-1, 0, ::2], torch.tensor([0.0, 3.6]).double(), atol=0.08, rtol=0)


def test_nothing_jumps_in_a_shot(shot):
    _, done = shot
    ends = done.motion.joint_positions()[:, list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))]
    peaks = body.measure_peaks(ends, done.motion.root_position, 30.0)
    assert peaks.step * 30 < 5.5
    assert peaks.acceleration < 110


@pytest.mark.parametrize(("label", "holds"), [("gait=run", [True]), ("walk-turn-left", [False]), ("style=active", [])])
def test_the_gait_of_a_label_is_a_constraint(label, holds):
    request = ShotRequest(LINE, labels=(label,))
    trajectory = plan_trajectory(request)
    motion = walk(len(trajectory.speeds))  # its toes slide: none is planted most of the time, as in a run
    found = [one for one in check_walk(request, trajectory, motion) if one.name.startswith("gait")]
    assert [constraint.holds for constraint in found] == holds


@pytest.mark.slow
def test_a_reach_far_aside_leaves_the_trajectory_and_is_reported():
    prior = priors.load("locomotion")
    reach = Reach(2.0, {"leftHand": (1.3, 0.9, 2.4)})
    done = solve_shot(
        prior, priors.load_inbetweener(), ShotRequest(curves.line(length=6), seconds=4.0, reaches=(reach,))
    )
    by_name = {constraint.name.split(" at")[0]: constraint for constraint in done.constraints}
    assert by_name["leftHand"].holds
    assert by_name["path"].holds, "away from the reach"
    hips = done.motion.root_position[:, 0]
    assert 0.3 < float(hips[60]) < 1.0
    assert float(hips[[0, -1]].abs().max()) < 0.1
    ends = done.motion.joint_positions()[:, list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))]
    assert body.measure_peaks(ends, done.motion.root_position, 30.0).step * 30 < 5.5


@pytest.mark.slow
def test_a_continuation_of_a_gesture_comes_to_rest_without_a_jolt():
    """Hands that were moving move on: the first steps are no harder than those within the clip and the shot."""
    prior, fps = priors.load("locomotion"), 30
    rest = build_rest_pose(prior, CANONICAL, TOE_REST_HEIGHT)
    frames = 40
    swing = 1.2 * torch.sin(torch.arange(frames, dtype=torch.float64) / fps * 2 * torch.pi / 0.9)
    quats = rest.local_quat_xyzw.expand(frames, -1, -1).clone()
    for name in ("leftUpperArm", "rightUpperArm"):
        turn = rotations.from_rotation_vector(swing[:, None] * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
        quats[:, CANONICAL.index(name)] = rotations.multiply(turn, quats[:, CANONICAL.index(name)])
    clip = replace(rest, root_position=rest.root_position.expand(frames, 3), local_quat_xyzw=quats)
    lead = Lead.of(clip, 28)
    assert lead.gestures
    curve = lead.bring_curve(LINE)
    done = solve_shot(prior, priors.load_inbetweener(), ShotRequest(curve, seconds=2.0, lead=lead))
    positions = torch.cat([clip.slice(0, 28).joint_positions(), done.motion.joint_positions()])
    bent = torch.diff(positions, n=2, dim=0).norm(dim=-1).amax(dim=1) * fps**2
    assert float(bent[24:32].max()) < 1.2 * max(float(bent[:24].max()), float(bent[40:].max()))
    moved = torch.diff(positions[28:36], dim=0).norm(dim=-1).amax() * fps
    assert float(moved) > 0.5, "it does not freeze"


APART = 0.6


def plan(points, walls) -> ShotPlan:
    curve = curves.from_points(torch.tensor(points, dtype=torch.float64), closed=False)
    request = ShotRequest(curve, obstacles=walls)
    return ShotPlan(Actor(curve="line:6"), request, priors.load("locomotion"), Character(), Fraction(30))


def meet(width: float) -> list[ShotPlan]:
    """Two who walk toward each other on one line through a passage."""
    walls = tuple(Obstacle((side * (width / 2 + 1.0), 3.0), size=(2.0, 2.4)) for side in (-1.0, 1.0))
    return [plan([(0.0, 0.0), (0.0, 6.0)], walls), plan([(0.0, 6.0), (0.0, 0.0)], walls)]


def hips(trajectory: Trajectory):
    return trajectory.curve.ground_point(trajectory.arcs)


@pytest.mark.slow
def test_in_a_narrow_passage_both_make_room():
    plans = meet(1.8)
    first, second = let_others_pass(plans, APART)
    assert second is plans[1]
    assert first.request.others is not None
    assert first.request.others.courtesy
    one = plan_trajectory(first.request)
    assert one.note is None
    other = plan_trajectory(replace(second.request, others=Others(hips(one)[None], APART)))
    assert other.note is None
    frames = min(len(one.arcs), len(other.arcs))
    away = (hips(one)[:frames] - hips(other)[:frames]).norm(dim=-1)
    assert float(away.min()) > APART
    aside = [float(hips(path)[int(away.argmin()), 0]) for path in (one, other)]
    assert min(map(abs, aside)) > 0.2
    assert aside[0] * aside[1] < 0
    alone = plan_trajectory(plans[0].request)
    assert plan_trajectory(replace(plans[1].request, others=Others(hips(alone)[None], APART))).note is not None


def test_where_there_is_room_for_two_the_first_one_makes_none():
    plans = meet(3.5)
    first, second = let_others_pass(plans, APART)
    assert (first, second) == tuple(plans)


@pytest.mark.slow
def test_no_toe_snaps_along_the_demos_curve():
    """Without the limit a toe is 14 cm further within one frame of this walk, and then stands: 132 m/s^2."""
    curve = curves.figure8(radius=2.0)
    walk = controllers.follow(priors.load("locomotion"), curve, seconds=18.5, generator=generator(0)).motion
    positions = walk.joint_positions()
    peaks = measure_peaks(positions[:, list(CANONICAL.indices(TOES))], positions[:, 0], float(walk.fps))
    assert peaks.acceleration < 90
    assert torch.isfinite(positions).all()


def test_a_slide_costs_what_a_viewer_sees_and_a_walk_does_not():
    motion, up = walk(90), torch.zeros(90, 2, dtype=torch.bool)
    first = torch.zeros(90, dtype=torch.long)
    sliding = replace(motion, local_quat_xyzw=motion.local_quat_xyzw[first])
    walks, slides = (compute_artefact_cost(each, up, (1, 89)) for each in (motion, sliding))
    assert slides > walks + 0.3
    round_about = motion.root_position.clone()
    round_about[:, 0] += torch.sin(torch.arange(90) / 89 * torch.pi) * 1.5
    assert compute_artefact_cost(replace(motion, root_position=round_about), up, (1, 89)) > walks


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("last", [(2.2, 2.2), (0.0, 0.6)], ids=["right angle", "reversal"])
def test_a_corner_is_kept_to_without_a_lunge(last, seed):
    prior = priors.load("locomotion")
    curve = curves.from_points(np.array([(0.0, 0.0), (0.0, 2.2), last]), closed=False)
    drawn = torch.Generator().manual_seed(seed)
    done = solve_shot(prior, priors.load_inbetweener(), ShotRequest(curve), generator=drawn)
    assert done.status.ok, done.status.text
    hips = done.motion.root_position[:, ::2]
    off = (hips - done.trajectory.curve.point(done.trajectory.curve.nearest(hips, done.trajectory.arcs))).norm(dim=-1)
    assert float(off.max()) < (0.1 if last[0] else 0.15), "what the page of limits says"
    toes = done.motion.joint_positions()[:, list(CANONICAL.indices(TOES))]
    assert float(torch.diff(toes, n=2, dim=0).norm(dim=-1).max()) * 900 < 88, "twice that of a circle of 2 m"
    wanted = math.pi / 2 if last[0] else math.pi
    turned = rotations.wrap_angle(kinematics.heading(done.motion.local_quat_xyzw[-30:, 0]) - wanted)
    # Over a stride: at each step hips turn to and fro, by up to 17 degrees in mocap.
    assert abs(float(turned.mean())) < math.radians(15)
    if not last[0]:
        assert float((done.trajectory.speeds == 0).sum()) > 10, "it turns on the spot"


@pytest.mark.parametrize(("curve", "heels"), [("circle:1", True), ("line:3", True), ("wave:0.5x2", False)])
def test_heels_are_left_free_where_the_way_has_a_corner(curve, heels, monkeypatch):
    class Walked(Exception):
        """Walking has begun."""

    def walk(*_given, settings, **_more):
        raise Walked(settings.footing.heels is not None)

    monkeypatch.setattr("controllers.shots.shot.walk_spans", walk)
    with pytest.raises(Walked, match=str(heels)):
        solve_shot(priors.load("locomotion"), priors.load_inbetweener(), ShotRequest(curves.read(curve)))
