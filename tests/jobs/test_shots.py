"""Shots: parts on their own, and one short shot by the bundled models, measured where a viewer looks."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers import walk

import priors
from controllers.shots.reaching import build_rest_pose, measure_look_errors, turn_heads
from controllers.shots.request import Lead, Look, Others, Reach, ShotRequest
from controllers.shots.shot import solve_shot
from controllers.shots.trajectory import StandingEnds, lay_timeline, plan_speeds, plan_trajectory
from mapctl import curves, rotations
from mapctl.curves.obstacles import Obstacle, measure_clearance
from mapctl.errors import RequestError
from mapctl.intent.path import SpeedProfile, TimedSpeed
from mapctl.metrics import body
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, TOES

LINE = curves.line(length=3)
STANDING = StandingEnds(start=True, end=True)


# What is done when


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


def test_a_way_past_somebody_who_comes_the_other_way_keeps_apart_when_they_meet():
    seconds = 5.0
    towards = torch.stack([torch.full((150,), 0.1), 6 - 1.2 * torch.arange(150) / 30], -1).double()
    request = ShotRequest(curves.line(length=6), seconds=seconds, others=Others(towards[None], 0.6))
    trajectory = plan_trajectory(request)
    assert trajectory.note is None
    there = trajectory.curve.point(trajectory.arcs)
    assert float((there - towards[: len(there)]).norm(dim=-1).min()) > 0.6
    alone = plan_trajectory(replace(request, others=None))
    assert float((alone.curve.point(alone.arcs) - towards[: len(alone.arcs)]).norm(dim=-1).min()) < 0.2


# Bad wishes


@pytest.mark.parametrize(
    ("wishes", "said"),
    [
        ({"speed": TimedSpeed((0.0,), (1.0,))}, "need the shot's seconds"),
        ({"obstacles": (Obstacle((0.1, 0.0), 0.5),)}, "the start is within the obstacle"),
        ({"seconds": 2.0, "reaches": (Reach(1.9, {"leftHand": (0, 1, 1)}, 0.3),)}, "not within the shot's 2 s"),
        (
            {"reaches": (Reach(1.0, {"leftHand": (0.3, 1, 1)}), Reach(1.05, {"leftHand": (0.3, 1.4, 1)}))},
            "two places 40 cm apart within two frames",
        ),
        ({"seconds": 2.0, "looks": (Look(2.5, (0, 1, 1)),)}, "not within the shot's 2 s"),
    ],
)
def test_wishes_that_make_no_sense_are_refused(wishes, said):
    with pytest.raises(RequestError, match=said):
        ShotRequest(LINE, **wishes)


@pytest.mark.parametrize("place", [(0.3, 2.6, 1.0), (2.6, 1.2, 1.2), (0.0, 1.2, 12.0)], ids=["high", "aside", "ahead"])
def test_what_no_arm_reaches_is_refused_with_its_distance(place):
    request = ShotRequest(LINE, seconds=2.0, reaches=(Reach(1.0, {"leftHand": place}),))
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
    places = pose.joint_positions()[0]
    toes = places[list(CANONICAL.indices(TOES))]
    torch.testing.assert_close(toes[:, 1], torch.full((2,), TOE_REST_HEIGHT).double(), atol=1e-3, rtol=0)
    assert 0.12 < float((toes[0] - toes[1]).norm()) < 0.4
    assert float(places[CANONICAL.index("head"), 1]) > 1.3
    hands = places[list(CANONICAL.indices(("leftHand", "rightHand")))]
    assert bool((hands[:, 1] < 1.0).all())
    assert float(hands[0, 0]) == pytest.approx(-float(hands[1, 0]), abs=1e-6)


def test_a_head_looks_where_it_is_told_and_back_without_a_jump():
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


def test_all_wishes_of_a_shot_hold(shot):
    _, done = shot
    assert done.status.ok, done.status.text
    assert {wish.name.split(" at")[0] for wish in done.wishes} >= {"path", "rightHand", "look", "obstacles", "stand"}
    assert all(wish.holds and wish.residual == 0 for wish in done.wishes)


def test_the_motion_of_a_shot_does_what_its_wishes_say(shot):
    request, done = shot
    places = done.motion.joint_positions()
    miss = places[69, CANONICAL.index("rightHand")] - torch.tensor([-0.45, 1.2, 1.5]).double()
    assert float(miss.norm()) < 0.01
    assert float(measure_clearance(request.obstacles, places[..., ::2]).amin()) > 0
    toes = places[:, list(CANONICAL.indices(TOES))]
    for part in (slice(0, 12), slice(-24, None)):
        assert float(toes[part].diff(dim=0).norm(dim=-1).mean()) * 30 < 0.02
        assert float((toes[part][:, 0] - toes[part][:, 1]).norm(dim=-1).max()) < 0.45
    torch.testing.assert_close(places[-1, 0, ::2], torch.tensor([0.0, 3.6]).double(), atol=0.08, rtol=0)


def test_nothing_jumps_in_a_shot(shot):
    _, done = shot
    ends = done.motion.joint_positions()[:, list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))]
    peaks = body.measure_peaks(ends, done.motion.root_position, 30.0)
    assert peaks.step * 30 < 5.5
    assert peaks.acceleration < 110


@pytest.mark.slow
def test_who_reaches_far_aside_leaves_the_way_for_it_and_is_told():
    prior = priors.load("locomotion")
    reach = Reach(2.0, {"leftHand": (1.3, 0.9, 2.4)})
    done = solve_shot(
        prior, priors.load_inbetweener(), ShotRequest(curves.line(length=6), seconds=4.0, reaches=(reach,))
    )
    by_name = {wish.name.split(" at")[0]: wish for wish in done.wishes}
    assert by_name["leftHand"].holds
    assert by_name["path"].holds, "away from the reach"
    hips = done.motion.root_position[:, 0]
    assert 0.3 < float(hips[60]) < 1.0
    assert float(hips[[0, -1]].abs().max()) < 0.1
    ends = done.motion.joint_positions()[:, list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))]
    assert body.measure_peaks(ends, done.motion.root_position, 30.0).step * 30 < 5.5


@pytest.mark.slow
def test_who_goes_on_from_a_gesture_comes_to_rest_without_a_jolt():
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
    places = torch.cat([clip.slice(0, 28).joint_positions(), done.motion.joint_positions()])
    bent = torch.diff(places, n=2, dim=0).norm(dim=-1).amax(dim=1) * fps**2
    assert float(bent[24:32].max()) < 1.2 * max(float(bent[:24].max()), float(bent[40:].max()))
    moved = torch.diff(places[28:36], dim=0).norm(dim=-1).amax() * fps
    assert float(moved) > 0.5, "it does not freeze"
