"""Two who meet in a passage: both make room where one alone cannot, and nobody does where there is enough."""

from dataclasses import replace
from fractions import Fraction

import pytest
import torch

import priors
from controllers.common.character import Character
from controllers.shots.request import Others, ShotRequest
from controllers.shots.trajectory import Trajectory, plan_trajectory
from mapctl import curves
from mapctl.commands.shared.shots import ShotPlan, let_others_pass
from mapctl.curves.obstacles import Obstacle
from scenes.scene_file import Actor

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
