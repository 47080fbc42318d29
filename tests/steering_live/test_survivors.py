"""Mutations that had survived: what each piece of code says to the letter, so that a changed letter is seen."""

import math
from dataclasses import replace

import pytest
import torch
from catalogue import trial
from helpers import generator
from tiny_horizon import BEGUN, METHOD, SHORT, request, solver, terms_of
from tiny_steering import AHEAD, QUICK, begun

from controllers.steering import loop, steer
from controllers.steering.cost import StepCost
from controllers.steering.loop import LoopSettings
from controllers.steering.relaxed_footing import RelaxedFootingFirst
from mapctl.intent.steering import Command, SteeringTarget
from mapctl.intent.steering_limits import SteeringLimits
from mapctl.problem.window_solvers import LatentNoiseSolver
from mapctl.terms import FootContact, RootVelocity


@pytest.mark.parametrize("planted", [True, False])
def test_a_toe_below_the_ground_costs_whether_it_is_planted_or_not(planted):
    one = trial(1, disturbed=0.0)
    one = replace(one, contacts=torch.full_like(one.contacts, planted))
    toes = [one.skeleton.index(name) for name in ("leftToes", "rightToes")]
    lowest = float(one.joints_world[..., toes, 1].amin())
    free = FootContact(rest_height=lowest, sigma_speed=1e6, sigma_height=1e6, heels=None)
    sunk = replace(free, rest_height=lowest + 0.2)
    below = (one.joints_world[..., toes, 1] - sunk.rest_height).clamp(max=0)
    assert float(free(one).sum()) == pytest.approx(0, abs=1e-6)
    torch.testing.assert_close(sunk(one), 0.5 * (below / 0.005).square().sum(-1), rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("frames", [21, 20])
def test_each_window_is_given_what_the_last_found_for_the_same_frames(frames):
    given, found = [], []

    def method(request):
        solved = METHOD(request)
        given.append(request.warm_start)
        found.append(solved.warm_start)
        return solved

    done, _ = solver(method).solve(BEGUN, terms_of, frames, generator=generator(0))
    step = SHORT.frames - SHORT.overlap
    for tail, carry in zip(given[1:], found, strict=False):
        assert torch.equal(tail, carry[step:])
    assert torch.equal(done.warm_start, found[-1][done.windows[-1].frames :])
    assert len(given[1]) == SHORT.overlap


def test_a_warm_start_begins_at_the_first_frame_of_the_window(monkeypatch):
    started = []

    def proposal(request, warm, meter):
        started.append(warm.unflatten(-1, (SHORT.frames, -1))[0])
        return warm

    done, _ = solver(replace(METHOD, proposal=proposal)).solve(BEGUN, terms_of, 14, generator=generator(0))
    assert len(done.windows) == 3
    assert float(started[1][: SHORT.overlap].abs().max()) > 0
    assert float(started[1][SHORT.overlap - 1].abs().max()) > 0
    assert float(started[1][SHORT.overlap :].abs().max()) == 0


def test_speed_falls_by_the_braking_limit_and_rises_by_the_acceleration():
    limits = SteeringLimits(acceleration=3.0, braking=0.5)
    assert SteeringTarget(2.0, 0, 0).step_toward(Command(0, 0), limits, 1.0).speed == pytest.approx(1.5)
    assert SteeringTarget(0.0, 0, 0).step_toward(Command(9, 0), limits, 1.0).speed == pytest.approx(3.0)


class Still:
    """A real clock that stands where it was last waited for."""

    real = True

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def wait_until(self, seconds):
        self.time = max(self.time, seconds)

    def hold(self, seconds):
        self.time -= seconds


@pytest.mark.parametrize("margin", [0.0, 0.03, 0.2])
def test_a_search_ends_by_the_margin_before_its_frames_are_due(monkeypatch, margin):
    allowed = []

    def watched(state, command, *, seconds=None):
        allowed.append(seconds)
        return steer.step(state, command, seconds=None)

    monkeypatch.setattr(loop, "step", watched)

    class Source:
        def at(self, seconds):
            return AHEAD

    loop.drive(begun()[0], Source(), [], frames=7, clock=Still(), settings=LoopSettings(margin=margin))
    least = StepCost().needed_seconds(QUICK.least_evaluations)  # as guessed before the first step
    assert allowed[0] == pytest.approx(max(least, QUICK.commit / 30 - margin))
    assert allowed[1] > QUICK.commit / 30 - margin - 1e-9


def test_who_is_stuck_is_searched_for_half_of_the_time_without_footing(monkeypatch):
    budgets = []
    solve = LatentNoiseSolver.__call__

    def watched(self, request):
        budgets.append((self.budget.within(request.seconds).seconds, {term.name for term in request.terms}))
        return solve(self, replace(request, seconds=math.inf))

    monkeypatch.setattr(LatentNoiseSolver, "__call__", watched)
    stuck = replace(begun()[0], settings=replace(QUICK, stuck=-1.0, random_starts=5))
    steer.step(stuck, AHEAD, seconds=60.0)
    (first, loose), (second, whole) = budgets
    assert first == pytest.approx(30, abs=0.1)
    assert second == pytest.approx(30, abs=0.1)
    assert "footing" not in loose
    assert "footing" in whole


@pytest.mark.parametrize(
    ("standing", "speed", "searches"), [(0.25, 1.2, 2), (0.25, 0.3, 1), (0.0, 1.2, 1)], ids=["goes", "creeps", "never"]
)
def test_who_stands_and_is_told_to_go_is_searched_for_without_footing_at_once(monkeypatch, standing, speed, searches):
    loose, facing, solve = [], [], LatentNoiseSolver.__call__

    def watched(self, request):
        loose.append("footing" not in {term.name for term in request.terms})
        facing.extend(term.sigma_facing for term in request.terms if isinstance(term, RootVelocity))
        return solve(self, request)

    settings = replace(QUICK, horizon=34, standing=standing, sigma_facing=0.5, sigma_leaving=0.2)
    state, _ = begun(Command(0.0, 0.0), settings=settings)
    walked = torch.zeros(steer._RECENT_FRAMES + 1, *state.committed.joints_world.shape[1:])
    stands = replace(state, committed=replace(state.committed, joints_world=walked))
    monkeypatch.setattr(LatentNoiseSolver, "__call__", watched)
    steer.step(stands, Command(speed, 0.0))
    assert len(loose) == searches
    assert loose[0] == (searches == 2)
    assert facing == ([0.2, 0.2] if searches == 2 else [0.5])


@pytest.mark.parametrize(("degrees", "times"), [(170, 1.6), (-100, 1.6), (60, 1.0)])
def test_a_start_far_aside_may_turn_faster_than_others(monkeypatch, degrees, times):
    facing, solve = [], LatentNoiseSolver.__call__

    def watched(self, request):
        facing.extend(term.facing for term in request.terms if isinstance(term, RootVelocity))
        return solve(self, request)

    settings = replace(QUICK, horizon=34, leaving_turn=1.6)
    state, _ = begun(Command(0.0, 0.0), settings=settings)
    still = torch.zeros(steer._RECENT_FRAMES + 1, *state.committed.joints_world.shape[1:])
    stands = replace(state, committed=replace(state.committed, joints_world=still))
    monkeypatch.setattr(LatentNoiseSolver, "__call__", watched)
    steer.step(stands, Command(1.2, math.radians(degrees)))
    turned = float(facing[0][0]) - stands.target.facing
    assert turned == pytest.approx(math.copysign(times * settings.limits.turn_rate / 30, degrees), rel=1e-4)


def test_both_searches_of_who_is_stuck_share_the_windows_time(monkeypatch):
    given, solve = [], LatentNoiseSolver.__call__

    def watched(self, request):
        given.append(request.seconds)
        return solve(self, replace(request, seconds=math.inf))

    monkeypatch.setattr(LatentNoiseSolver, "__call__", watched)
    terms = terms_of(1, SHORT.frames)
    RelaxedFootingFirst(METHOD, METHOD, terms)(replace(request(BEGUN, terms), seconds=8.0))
    assert given == [4.0, 4.0]
