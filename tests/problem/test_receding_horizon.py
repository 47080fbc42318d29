"""Windows: each lowers its energy, together they are one motion, and limits hold."""

import time
from dataclasses import replace
from typing import ClassVar

import pytest
import torch
from helpers import generator, tiny_density
from tiny_horizon import BEGUN, DENSITY, METHOD, SHORT, request, solver, terms_of

from mapctl import rotations
from mapctl.features import GroundPose, integrate_root
from mapctl.kinematics import heading
from mapctl.metrics.feet import locate_heels
from mapctl.pose import decode
from mapctl.problem.solution import Outcome
from mapctl.problem.window_solvers import LatentNoiseSolver, SwarmProposal
from mapctl.skeleton import CANONICAL, FEET
from mapctl.solver.budget import Budget
from mapctl.solver.lbfgs import LbfgsSettings
from mapctl.solver.swarm import SwarmSettings
from mapctl.terms import LatentPrior, Likelihood


def solve(frames=20, *, method=METHOD, density=DENSITY, seed=0, **limits):
    return solver(method, density).solve(BEGUN, terms_of, frames, generator=generator(seed), **limits)


METHODS = {
    "zero start": METHOD,
    "best of": replace(METHOD, proposal=SwarmProposal(SwarmSettings(particles=4, iterations=1))),
    "swarm": replace(METHOD, proposal=SwarmProposal(SwarmSettings(particles=4, iterations=2))),
}


@pytest.mark.parametrize("name", METHODS)
def test_a_window_ends_lower_than_it_began_within_its_budget(name):
    terms = (*terms_of(1, SHORT.frames), Likelihood())
    begun = BEGUN
    solved = METHODS[name](request(begun, terms))
    assert solved.record.energy < solved.record.start_energy
    assert solved.record.evaluations <= 12
    assert sum(float(e.energy.sum()) for e in solved.ledger.entries) == pytest.approx(solved.record.energy, rel=1e-4)
    assert solved.warm_start.shape[0] == SHORT.frames
    assert not solved.trial.features.requires_grad


@pytest.mark.slow
def test_windows_join_without_a_seam():
    done, outcome = solve(21)
    assert outcome is Outcome.DONE
    assert len(done.features) == 21
    assert [record.frames for record in done.windows] == [6, 6, 6, 2]
    begun = BEGUN
    ground, heading = integrate_root(done.features[1:], begun.ground_pose)
    torch.testing.assert_close((done.ground_pose.position_xz, done.ground_pose.heading), (ground[-1], heading[-1]))
    expected = DENSITY.advance(begun.state, done.features[None, 1:])
    for part in ("last_frame", "hidden", "cell"):
        torch.testing.assert_close(getattr(done.state, part), getattr(expected, part))
    assert all(len(entry.energy) == 20 for entry in done.ledger.entries)
    assert done.joints_world.shape == (SHORT.past, 21, 3)
    torch.testing.assert_close(done.joints_world[-1, 0, ::2], ground[-1], atol=1e-5, rtol=1e-5)


def test_every_window_keeps_its_budget_and_progress_is_reported():
    given = []
    done, _ = solve(20, progress=lambda now, total: given.append((now, total)))
    assert all(record.evaluations <= 12 for record in done.windows)
    assert all(record.energy <= record.start_energy for record in done.windows)
    assert given == [(7, 20), (13, 20), (19, 20), (20, 20)]


def test_a_deadline_reaches_into_a_window():
    endless = LatentNoiseSolver(
        lbfgs=LbfgsSettings(max_iterations=10**6, relative_energy_tolerance=-1.0), budget=Budget()
    )
    began = time.monotonic()
    done, outcome = solve(80, method=endless, deadline=began + 0.5)
    assert outcome is Outcome.BUDGET
    assert time.monotonic() - began < 2
    assert done.windows[-1].evaluations > 0


def test_an_interrupt_keeps_whole_windows_and_goes_on_where_there_is_none():
    def press(done, total):
        raise KeyboardInterrupt

    done, outcome = solve(20, progress=press)
    assert outcome is Outcome.INTERRUPTED
    assert len(done.features) == 7
    with pytest.raises(KeyboardInterrupt):
        solver(density=interrupted()).solve(BEGUN, terms_of, 20, generator=generator())


def interrupted():
    """A density in whose first rollout Ctrl-C is pressed."""
    density = replace(tiny_density(), use_fast=False)
    model = density.reference

    def press(state, noise, plan):
        raise KeyboardInterrupt

    model.rollout = press
    return density


def broken(after):
    """A density that answers NaN from its window number `after` on."""
    density = replace(tiny_density(), use_fast=False)
    model = density.reference
    rollout, advance, windows = model.rollout, model.advance, [0]

    def counting(state, committed):
        windows[0] += 1
        return advance(state, committed)

    def failing(state, noise, plan):
        features, nats = rollout(state, noise, plan)
        return (features * torch.nan, nats * torch.nan) if windows[0] >= after else (features, nats)

    model.advance, model.rollout = counting, failing
    return density


@pytest.mark.slow
@pytest.mark.parametrize("after", [0, 2])
def test_a_density_that_breaks_down_ends_the_solve_with_the_finite_frames(after):
    done, outcome = solve(20, density=broken(after))
    assert outcome is Outcome.NOT_FINITE
    assert len(done.features) == 1 + 6 * after
    for values in (done.features, done.state.hidden, done.joints_world, done.ground_pose.position_xz):
        assert bool(torch.isfinite(values).all())
    assert all(len(entry.energy) == 6 * after for entry in done.ledger.entries)


class Clock(LatentPrior):
    """Remembers the times of the frames it was shown."""

    shown: ClassVar[list[float]] = []

    def residual(self, trial):
        self.shown.append(float(trial.seconds[0]))
        return super().residual(trial)


def test_terms_know_the_time_of_the_frames_they_see():
    Clock.shown.clear()
    solver().solve(BEGUN, lambda first, frames: (Clock(),), 20, generator=generator())
    assert Clock.shown == pytest.approx([1 / 30, 7 / 30, 13 / 30, 19 / 30])
    Clock.shown.clear()
    done, _ = solver().solve(BEGUN, lambda first, frames: (Clock(),), 7, generator=generator())
    short = done.discard_history(2)
    assert (len(short.features), short.discarded, short.windows) == (2, 5, ())
    solver().solve(short, lambda first, frames: (Clock(),), 8, generator=generator())
    assert Clock.shown[-1] == pytest.approx(7 / 30)


@pytest.mark.parametrize(
    ("frames", "laid"), [(50, [(10, 6)] * 7 + [(8, 8)]), (10, [(10, 10)]), (3, [(3, 3)]), (11, [(10, 6), (5, 5)])]
)
def test_windows_may_end_with_the_motion(frames, laid):
    settings, done, found = replace(SHORT, beyond_end=False), 0, []
    while done < frames:
        found.append(settings.lay_window(done, frames))
        done += found[-1][1]
    assert (found, done) == (laid, frames)


def test_a_window_knows_the_heels_of_the_frame_before():
    done, _ = solve(11)
    (heels,) = done.locate_heels(CANONICAL)
    last = decode(done.features, GroundPose.origin())
    feet = last.skeleton.indices(FEET)
    wanted = locate_heels(last)[-1] - last.joint_positions()[-1, feet]
    turn = done.ground_pose.heading.double() - heading(last.local_quat_xyzw[-1, 0])
    wanted = rotations.rotate(rotations.about_y(turn).expand(2, 4), wanted)
    torch.testing.assert_close(heels.double() - done.joints_world[-1, feet].double(), wanted, atol=1e-5, rtol=0)
    assert len(replace(done, features=done.features[:0]).locate_heels(CANONICAL)) == 0
    assert len(replace(done, joints_world=done.joints_world[:0]).locate_heels(CANONICAL)) == 0
