"""Steering with an untrained density: the contract of a step and of the loop, not the quality of the walk."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import generator
from tiny_prior import save_tiny_prior
from tiny_steering import AHEAD, DENSITY, QUICK, begun

import priors
from controllers.steering import steer
from controllers.steering.loop import Recorder, StepRecord, StreamClock, drive, summarise_step_timing
from controllers.steering.process import Autopilot
from mapctl import curves
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.intent.steering import SteeringLimits


def steered(steps, command=AHEAD, **how):
    state, first = begun(command, **how)
    pieces = [first]
    for _ in range(steps):
        state, piece = steer.step(state, command)
        pieces.append(piece)
    return state, pieces


def test_a_step_is_pure_and_the_same_to_the_bit():
    state, _ = begun()
    before = state.committed.features.clone()
    (after, one), (_, two) = steer.step(state, AHEAD), steer.step(state, AHEAD)
    assert torch.equal(one.motion.local_quat_xyzw, two.motion.local_quat_xyzw)
    assert torch.equal(one.motion.root_position, two.motion.root_position)
    assert torch.equal(state.committed.features, before)
    assert state.frames == 1
    assert after.frames == 4


def test_a_step_delivers_its_frames_with_a_forecast_and_a_ledger():
    _, pieces = steered(3)
    for piece in pieces[1:]:
        assert piece.motion.num_frames == len(piece.steering_targets) == len(piece.contacts) == 3
        assert piece.forecast.shape == (5, 21, 3)
        assert 1 <= piece.evaluations <= 4
        assert {entry.name for entry in piece.ledger.entries} == {"noise", "travel", "footing"}
    roots = torch.cat([piece.motion.root_position for piece in pieces])
    assert float(roots.diff(dim=0).norm(dim=-1).max()) < 0.3
    ahead = pieces[1].forecast[0, 0] - pieces[1].motion.root_position[-1].float()
    assert float(ahead.norm()) < 0.3


def test_walks_differ_by_their_seed_as_far_as_they_are_lively():
    """One noise belongs to a frame, whichever window it is in."""
    for liveliness in (0.0, 0.5):
        state, _ = begun(settings=replace(QUICK, liveliness=liveliness))
        one, other = (steer.step(replace(state, seed=seed), AHEAD)[1].motion.root_position for seed in (1, 2))
        assert torch.equal(one, other) == (liveliness == 0)
    now, later = (steer._draw_noise(replace(state, frames=frames)) for frames in (4, 7))
    assert torch.equal(now[3:], later[:-3])
    assert float(now.std()) == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("least", [0, 2])
def test_without_time_it_still_delivers_with_a_note(least):
    state, _ = begun(settings=replace(QUICK, least_evaluations=least))
    _, piece = steer.step(state, AHEAD, seconds=0.0)
    assert piece.motion.num_frames == 3
    assert piece.evaluations == 0
    assert piece.notes == ("the deadline came after 0 of 4 evaluations",)
    assert bool(torch.isfinite(piece.motion.local_quat_xyzw).all())


def test_motion_that_is_not_finite_is_replaced_by_the_priors_own():
    state, _ = steered(2)
    broken = replace(state, committed=replace(state.committed, warm_start=state.committed.warm_start * math.nan))
    _, piece = steer.step(broken, AHEAD)
    assert bool(torch.isfinite(piece.motion.local_quat_xyzw).all())
    assert bool(torch.isfinite(piece.motion.root_position).all())


def test_a_command_conditions_the_prior_while_it_holds(tmp_path):
    prior = priors.load(str(save_tiny_prior(tmp_path / "p.safetensors", labels=("gait=run", "style=active"))))
    state, _ = steer.begin(prior, AHEAD, generator=generator(), settings=QUICK)
    printed = replace(AHEAD, labels=("run", "active"))
    after, said = steer.step(state, printed)
    _, unsaid = steer.step(state, AHEAD)
    assert not torch.equal(said.motion.local_quat_xyzw, unsaid.motion.local_quat_xyzw)
    assert after.prior is prior, "conditions are not carried on"
    with pytest.raises(RequestError, match="has no gait or style 'swim'"):
        steer.step(state, replace(AHEAD, labels=("swim",)))


def test_the_loop_asks_a_step_before_frames_are_due_and_shows_them_all():
    state, first = begun()
    times, recorder = [], Recorder()

    def source(seconds):
        times.append(seconds)
        return AHEAD

    recorder.show(first, 0.0)
    state, records = drive(state, source, [recorder.show], frames=20, clock=StreamClock())
    assert state.frames == 22
    assert recorder.motion(20).num_frames == 20
    assert times == pytest.approx([k / 10 + 1 / 30 - 0.1 for k in range(7)])
    assert [record.due for record in records] == pytest.approx([k / 10 + 1 / 30 for k in range(7)])
    assert all(len(entry.energy) == 21 for entry in recorder.ledger.entries)


class Labouring(StreamClock):
    """Real time in which every step takes so many seconds, and all else none."""

    real = True

    def __init__(self, seconds):
        super().__init__()
        self.seconds, self.held, self._asked = seconds, 0.0, False

    def now(self):
        return self._now

    def wait_until(self, seconds):
        super().wait_until(seconds)
        self._asked = True

    def hold(self, seconds):
        self.held += seconds
        self._now -= seconds

    def at(self, seconds):
        self._now += self.seconds
        return AHEAD


@pytest.mark.parametrize(
    ("seconds", "rate"), [(0.08, 1.0), pytest.param(0.13, 0.1 / 0.13, marks=pytest.mark.slow), (0.5, 0.1 / 0.5)]
)
def test_time_stretches_where_steps_take_longer_than_their_frames_last_and_no_frame_is_lost(seconds, rate):
    clock, shown = Labouring(seconds), Recorder()
    _, records = drive(begun()[0], clock.at, [shown.show], frames=120, clock=clock)
    assert shown.motion().num_frames == 120
    streamed = records[-1].due - records[0].due
    assert streamed / (streamed + summarise_step_timing(records)["held_s"]) == pytest.approx(rate, abs=0.03)
    assert max(record.delivered - record.due for record in records[3:]) <= 0.1 + seconds, "the lag does not grow"
    asked = [record.asked - record.due for record in records]
    assert min(asked) >= -0.1 - 1e-9


def test_steps_that_others_hold_up_are_to_end_earlier():
    clock, allowed = Labouring(0.0), []

    def held_up(state, command, *, seconds=None):
        allowed.append(seconds)
        clock._now += seconds + 0.012
        return steer.step(state, command)

    _, records = drive(begun()[0], clock.at, [], frames=40, clock=clock, stepper=held_up)
    spare = [record.due - record.delivered for record in records]
    assert allowed[0] == pytest.approx(0.085)
    assert spare[0] == pytest.approx(0.003)
    assert min(spare[3:]) > 0.009


def test_latency_runs_from_the_arrival_to_the_first_frame_that_could_change():
    records = [StepRecord(3, k / 10, k / 10 + 0.1, k / 10 + 0.05, 0.06, 4, "") for k in range(5)]
    assert summarise_step_timing(records, [0.1])["command_latency_s"] == pytest.approx(0.1)
    assert summarise_step_timing(records, [0.11, 0.3])["command_latency_s"] == pytest.approx(0.19)
    assert summarise_step_timing(records)["command_latency_s"] == pytest.approx(0.2)
    assert summarise_step_timing(records)["frame_ms_p50"] == pytest.approx(20)
    assert summarise_step_timing(records)["evaluations_per_frame"] == pytest.approx(4 / 3)


def test_pursuit_heads_for_the_curve_ahead_of_the_character():
    curve = curves.line(length=10)
    pilot = Autopilot(AHEAD, SteeringLimits())
    pilot.walk(curve, 1.0)
    assert pilot.at(0).heading == pytest.approx(curve.start_heading)
    x, z = curve.point(0.3)[[0, -1]].tolist()
    _, first = steer.begin(DENSITY, AHEAD, generator=generator(), at=(x + 0.5, z))
    pilot.show(first, 0.0)
    assert pilot.at(0.1).heading == pytest.approx(-math.pi / 4, abs=0.02)
    assert pilot.at(0.1).speed == 1.0


def test_obstacles_lead_the_direction_round_and_hold_joints_off():
    state, _ = begun()
    disc = (Obstacle((0.0, 1.2), 0.4),)
    _, calm = steer.step(state, AHEAD)
    _, led = steer.step(state, replace(AHEAD, obstacles=disc))
    assert abs(led.steering_targets[-1].heading) > 0.05 > abs(calm.steering_targets[-1].heading)
    names = {entry.name for entry in led.ledger.entries}
    assert names == {entry.name for entry in calm.ledger.entries} | {"clear"}
