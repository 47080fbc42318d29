"""What a step is expected to cost, and steps that end in time on a clock on which everything takes as long as told."""

import functools
import itertools
import time
from dataclasses import replace

import pytest
from test_steer import AHEAD, QUICK, begun

from controllers.steering import steer
from controllers.steering.steer import StepCost
from mapctl.problem import window_solvers
from mapctl.problem.objective import Objective
from mapctl.solver.budget import Meter


def test_a_cost_is_learned_from_steps_and_a_longer_one_is_believed_later():
    first = StepCost(0.002)
    assert first.needed_seconds(6) == pytest.approx(first.rest + 0.012)
    slower, faster = (first.learn(14 * one, 14, search=None, cut_short=False).evaluation for one in (0.004, 0.001))
    assert first.evaluation < slower < 0.0025
    assert 0.001 < faster < 0.0017


def test_a_search_that_was_cut_tells_what_comes_after_it():
    cost = StepCost(0.002, 0.004)
    for _ in range(60):
        cost = cost.learn(cost.limit_search(0.05) + 0.009, 10, search=cost.limit_search(0.05), cut_short=True)
    assert cost.rest == pytest.approx(0.009, abs=5e-4)
    assert cost.limit_search(0.05) == pytest.approx(0.041, abs=5e-4)
    assert cost.learn(9.0, 10, search=0.04, cut_short=True).rest <= 0.02, "that was another process"
    assert cost.learn(0.001, 10, search=None, cut_short=False).rest == cost.rest


@pytest.mark.slow
@pytest.mark.parametrize("free", [False, True], ids=["walking", "stuck"])
def test_steps_return_within_their_time(monkeypatch, free):
    """An evaluation takes 2 ms, the rest of a step 3 ms before the search ends and after it."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(window_solvers, "Meter", functools.partial(Meter, clock=lambda: now[0]))
    evaluate, decode = Objective.energy_and_gradient, steer.decode

    def slow_evaluate(self, x):
        now[0] += 0.002 * len(x)
        return evaluate(self, x)

    def slow_decode(*given, **named):
        now[0] += 0.003
        return decode(*given, **named)

    monkeypatch.setattr(Objective, "energy_and_gradient", slow_evaluate)
    monkeypatch.setattr(steer, "decode", slow_decode)
    settings = replace(QUICK, evaluations=20, random_starts=2, stuck=-1.0 if free else 9.0)
    for seconds in (0.006, 0.012, 0.031):
        state, _ = begun(settings=settings)
        state, made = replace(state, cost=StepCost(0.002)), []
        for _ in range(8):
            began = now[0]
            state, frames = steer.step(state, AHEAD, seconds=seconds)
            made.append(frames.evaluations)
            assert now[0] - began <= seconds + 0.003, (frames.evaluations, frames.notes, state.cost)
    assert max(made) > 0
    assert list(itertools.accumulate(made))[-1] >= 8 * 5
