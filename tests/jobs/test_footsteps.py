"""Footsteps: a foot stands while the other swings, at planned footholds; displacements without steps are named."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

import priors
from controllers.shots.constraints import check_walk
from controllers.shots.footsteps import (
    Displacement,
    Footstep,
    LastSteps,
    find_footsteps,
    hold_footsteps,
    plan_footsteps,
    take_given,
    take_steps,
)
from controllers.shots.reaching import build_rest_pose
from controllers.shots.request import ShotRequest
from controllers.shots.trajectory import plan_trajectory
from mapctl import curves, rotations
from mapctl.errors import RequestError
from mapctl.kinematics.moving import move_to, rotate_about_vertical
from mapctl.metrics.body import measure_glide
from mapctl.retarget.legs import bend_legs
from mapctl.skeleton import CANONICAL, FEET, TOES

FOUR = [*CANONICAL.indices(TOES), *CANONICAL.indices(FEET)]
CASES = {
    "20 cm": (0.0, 0.2, 0.0),
    "70 cm": (0.0, 0.7, 0.0),
    "2 m": (0.0, 2.0, 0.0),
    "aside": (0.4, 0.0, 0.0),
    "back": (0.0, -0.5, 0.0),
    "a quarter turn": (0.0, 0.0, math.pi / 2),
    "about": (0.0, 0.0, -math.pi),
}


@pytest.fixture(scope="module")
def rest(prior):
    return build_rest_pose(priors.load(prior), CANONICAL, 0.0425)


def displace(rest, x, z, turn):
    stop = move_to(rotate_about_vertical(rest, turn), torch.tensor([x, z], dtype=torch.float64))
    share = torch.linspace(0, 1, 30, dtype=torch.float64)
    return Displacement(rest, stop, torch.stack([x * share, z * share, turn * share], dim=-1))


@pytest.mark.parametrize("case", CASES)
def test_a_foot_stands_while_the_other_swings(rest, case):
    displacement = displace(rest, *CASES[case])
    frames = displacement.count_frames()
    plan = plan_footsteps(displacement, frames)
    motion = take_steps(displacement, plan, frames)
    positions = motion.joint_positions()
    ends = [displacement.start.joint_positions(), displacement.stop.joint_positions()]
    torch.testing.assert_close(positions[[0, -1]], torch.cat(ends))
    assert [step.foot for step in plan[1:]] == [1 - step.foot for step in plan[:-1]]
    assert all(one.land < other.lift for one, other in pairwise(plan))
    toes = positions[:, FOUR[:2]]
    for foot in range(2):
        steps = [step for step in plan if step.foot == foot]
        for step in steps:
            assert toes[step.land, foot, ::2].tolist() == pytest.approx(step.toe, abs=1e-6)
        swings = torch.zeros(frames - 1, dtype=torch.bool)
        for step in steps:
            swings[step.lift : step.land] = True
        assert float(torch.diff(toes[:, foot, ::2], dim=0).norm(dim=-1)[~swings].max()) < 1e-6
    assert float(toes[..., 1].min()) > 0.0425 - 1e-3
    assert float(positions.diff(n=2, dim=0).norm(dim=-1).max()) * 900 < 45
    assert measure_glide(positions[:, FOUR], 30.0) == 0.0


def test_a_body_that_stays_takes_no_step(rest):
    assert plan_footsteps(displace(rest, 0.0, 0.01, 0.0), 30) == []


def test_a_step_to_the_side_begins_with_the_foot_of_that_side(rest):
    for x, foot in ((0.4, 0), (-0.4, 1)):  # left is +x
        assert plan_footsteps(displace(rest, x, 0.0, 0.0), 39)[0].foot == foot


def test_there_is_a_step_at_least_every_second_and_a_half(rest):
    plan = plan_footsteps(displace(rest, 0.0, 0.5, 0.0), 300)
    assert max(step.land - step.lift for step in plan) <= 45


def test_a_displacement_out_of_a_corner_faces_along_the_curve(rest):
    corner = curves.from_points(torch.tensor([[0.0, 0.0], [0.0, 2.0], [1.0, 1.0]], dtype=torch.float64), closed=False)
    turned = math.radians(135)
    start = move_to(rotate_about_vertical(rest, turned), torch.tensor([0.0, 2.0], dtype=torch.float64))
    stop = move_to(rotate_about_vertical(rest, turned), torch.tensor([1.0, 1.0], dtype=torch.float64))
    arcs = torch.tensor([2.0, corner.length], dtype=torch.float64)
    heading = Displacement.along(corner, arcs, start, stop).track[:, 2]
    torch.testing.assert_close(heading, torch.full_like(heading, turned), atol=1e-3, rtol=0)


def test_last_steps_land_on_the_footholds_of_the_stand(rest):
    plan = plan_footsteps(displace(rest, 0.0, 1.2, 0.0), 73)
    steps = take_steps(displace(rest, 0.0, 1.2, 0.0), plan, 73)
    walked = steps.join(steps.slice(72, 73)).join(steps.slice(72, 73))
    start = (plan[-2].lift + plan[-2].land) // 2
    root, quats = walked.root_position.clone(), walked.local_quat_xyzw.clone()
    quats[start + 1 : 72] = quats[72]  # legs that do not step between
    last = LastSteps(replace(walked, root_position=root, local_quat_xyzw=quats), start, 72)
    motion = last.take()
    toes = motion.joint_positions()[:, FOUR[:2]]
    torch.testing.assert_close(toes[-1], steps.joint_positions()[-1, FOUR[:2]])
    assert [step.foot for step in last.plan()] == [plan[-2].foot, plan[-1].foot]
    assert measure_glide(motion.joint_positions()[:, FOUR], 30.0) == 0.0


def test_given_footsteps_are_taken_and_found_again(rest):
    displacement, frames = displace(rest, 0.0, 1.2, 0.0), 73
    plan = plan_footsteps(displacement, frames)
    x, z = plan[1].toe
    given = [replace(step, lift=step.lift + 20, land=step.land + 20) for step in plan]
    given[1] = replace(given[1], toe=(x + 0.06, z - 0.05))
    motion = take_steps(displacement, take_given(given, 20), frames)
    toes = motion.joint_positions()[:, FOUR[:2]]
    assert toes[plan[1].land, plan[1].foot, ::2].tolist() == pytest.approx([x + 0.06, z - 0.05], abs=1e-6)
    torch.testing.assert_close(toes[-1], displacement.stop.joint_positions()[0, FOUR[:2]])
    found = find_footsteps(motion)
    assert [step.foot for step in found] == [step.foot for step in plan]
    assert max(math.dist(one.toe, other.toe) for one, other in zip(found, take_given(given, 20), strict=True)) < 0.03
    with pytest.raises(RequestError, match="need both feet"):
        take_given(given[:1], 20)


def test_a_leg_that_was_bent_backward_bends_forward(rest):
    quats, knee = rest.local_quat_xyzw.clone(), CANONICAL.index("leftLowerLeg")
    quats[:, knee] = rotations.from_rotation_vector(torch.tensor([[-0.1, 0.0, 0.0]], dtype=torch.float64))
    feet = list(CANONICAL.indices(FEET))
    ankles, turns = rest.joint_positions()[:, feet], rest.joint_rotations()[:, feet]
    bent = bend_legs(replace(rest, local_quat_xyzw=quats), ankles, turns)
    torch.testing.assert_close(bent.joint_positions()[:, feet], ankles)
    assert float(rotations.to_rotation_vector(bent.local_quat_xyzw[:, knee])[0, 0]) > 0.1


def test_walks_are_held_to_footholds_from_the_landing_on():
    term = hold_footsteps([Footstep(1, 8, 14, toe=(0.3, 2.0))], 10, 12, 0.04)
    assert term.wanted.nonzero().tolist() == [[frame, CANONICAL.index(TOES[1])] for frame in range(4, 10)]
    assert term.positions[4, CANONICAL.index(TOES[1])].tolist() == [0.3, 0.04, 2.0]


def test_a_displacement_without_steps_does_not_hold(rest):
    curve = curves.line(length=0.7)
    trajectory = plan_trajectory(request := ShotRequest(curve, stand_at_start=True, stand_at_end=True))
    frames = len(trajectory.arcs)
    root = rest.root_position.expand(frames, 3).clone()
    root[:, 2] += trajectory.arcs
    slid = replace(rest, root_position=root, local_quat_xyzw=rest.local_quat_xyzw.expand(frames, -1, 4))
    found = {one.name: one for one in check_walk(request, trajectory, slid)}
    assert not found["feet"].holds
    assert found["feet"].got > 40
    assert found["acceleration"].holds
