"""Slow motion and sigmas that change while a character moves: the time, the settings, and the steps."""

import math
from dataclasses import replace

import pytest
from tiny_steering import QUICK, begun

from controllers.steering import steer
from controllers.steering.loop import StreamClock, iterate_steps
from controllers.steering.sigmas import TunedStepper, change_sigmas, describe_sigmas
from mapctl.errors import RequestError
from mapctl.intent.steering import Command
from mapctl.runtime import stream_time
from mapctl.runtime.stream_time import StreamTime


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(stream_time.time, "perf_counter", lambda: now[0])
    return now


def test_time_is_real_until_it_is_paused_slowed_or_set_back(clock):
    time = StreamTime()
    clock[0] = 101.0
    assert (time.now(), time.perf_counter_at(103.0), time.wait_seconds(103.0)) == (101.0, 103.0, 2.0)
    time.set_rate(0.25)
    clock[0] = 105.0
    assert time.now() == 102.0
    assert (time.wait_seconds(103.0), time.perf_counter_at(103.0), time.wait_seconds(90.0)) == (4.0, 109.0, 0.0)
    time.pause(True)
    time.pause(True)
    clock[0] = 200.0
    assert (time.now(), time.wait_seconds(103.0)) == (102.0, None)
    time.set_rate(0.5)
    time.pause(False)
    clock[0] = 202.0
    assert time.now() == 103.0
    time.hold(1.0)
    assert (time.now(), time.perf_counter_at(103.0)) == (102.0, 204.0)


def test_every_sigma_reaches_its_term_and_no_other():
    ranges = describe_sigmas(QUICK)
    assert len({one.name for one in ranges}) == len(ranges) == 7
    for one in ranges:
        changed = change_sigmas(QUICK, {one.name: 2 * one.default})
        found = {other.name: other.default for other in describe_sigmas(changed)}
        assert found == {other.name: other.default * (1 + (other.name == one.name)) for other in ranges}
        assert one.low < one.default < one.high
    assert change_sigmas(QUICK, {}) == QUICK


def test_sigmas_of_heels_change_with_those_of_toes():
    heels = QUICK.footing.heels
    assert heels is not None
    for name, part in (("foot speed", "speed"), ("foot height", "height"), ("foot below", "below")):
        default = next(one.default for one in describe_sigmas(QUICK) if one.name == name)
        changed = change_sigmas(QUICK, {name: 3 * default}).footing
        assert vars(changed.heels) == pytest.approx(vars(heels) | {part: 3 * getattr(heels, part)})
    without = replace(QUICK, footing=replace(QUICK.footing, heels=None))
    assert change_sigmas(without, {"foot speed": 0.1}).footing.heels is None


def sway(sigmas) -> tuple[float, float]:
    """How the first steps begin and end, once the sigmas changed after the first."""
    tuned, places = TunedStepper(steer.step, QUICK), []
    state, _ = begun()
    for number, (after, _) in enumerate(
        iterate_steps(
            state, type("Source", (), {"at": lambda *_: Command(2.0, 1.0)})(), [], clock=StreamClock(), stepper=tuned
        )
    ):
        places.append(after.committed.joints_world[-1, 0].tolist())
        if number == 0:
            tuned.tune(sigmas)
        if number == 2:
            return places


def test_a_sigma_takes_effect_at_the_next_step_and_a_reset_undoes_it():
    plain, wide = sway({}), sway({"speed": 1.5, "noise": 0.2})
    assert plain[0] == wide[0]
    assert math.dist(plain[1], wide[1]) > 1e-4
    tuned = TunedStepper(steer.step, QUICK)
    tuned.tune({"speed": 1.5})
    tuned.tune({})
    assert tuned(begun()[0], Command(2.0, 1.0))[1].motion.root_position.tolist() == (
        steer.step(begun()[0], Command(2.0, 1.0))[1].motion.root_position.tolist()
    )


@pytest.mark.parametrize("value", [0.0, -0.1, 1e9, math.nan, math.inf, 0.1 / 16.1])
def test_a_sigma_out_of_its_range_is_refused_and_the_one_before_holds(value):
    tuned = TunedStepper(steer.step, QUICK)
    with pytest.raises(RequestError, match=r"sigma of speed cannot be .*: it can be 0.00625 to 1.6 m/s"):
        tuned.tune({"speed": value})
    assert tuned._changed is None
    with pytest.raises(RequestError, match="no sigma 'spead', only speed, direction"):
        tuned.tune({"spead": 0.1})
