"""What a page asks of a character: whatever it is, what holds is what the prior can do, and the rest is said."""

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mapctl.intent.steering import Command
from scenes.live.inputs import UNCONDITIONED, InputLimits, SteeringInputs

BOUNDS = InputLimits(3.8, {"gait": ["run", "walk"], "style": ["old"]})
ANYTHING = st.one_of(
    st.floats(), st.integers(), st.text(max_size=5), st.none(), st.booleans(), st.lists(st.floats(), max_size=2)
)
CHANGES = st.dictionaries(st.sampled_from(["speed", "heading", "facing", "step_length"]), ANYTHING)


@settings(suppress_health_check=[HealthCheck.too_slow])  # on a starved core
@given(CHANGES, CHANGES)
def test_whatever_is_asked_the_orders_are_a_command_within_bounds(first, second):
    orders = SteeringInputs()
    for changes in (first, second):
        orders, refusals = BOUNDS.changed(orders, changes)
        command = orders.command
        assert command.within(3.8) == (command, [])
        assert abs(orders.heading) <= 180
        assert orders.facing is None or abs(orders.facing) <= 180
        assert all(refusal.name in changes and refusal.text for refusal in refusals)
    assert BOUNDS.changed(orders, {})[0] == orders


@pytest.mark.parametrize(
    ("name", "asked", "held", "text"),
    [
        ("speed", -5.0, 0.0, "A speed of -5 m/s was raised to 0: it can be 0 to 3.8 m/s."),
        ("speed", 99, 3.8, "A speed of 99 m/s was lowered to 3.8: it can be 0 to 3.8 m/s."),
        ("speed", 1e9, 3.8, "A speed of 1e+09 m/s was lowered to 3.8: it can be 0 to 3.8 m/s."),
        ("speed", math.nan, 1.2, "'nan' is no number; 1.2 holds"),
        ("speed", "fast", 1.2, "'fast' is no number; 1.2 holds"),
        ("speed", None, 1.2, "'None' is no number; 1.2 holds"),
        ("step_length", 0, 0.3, "A step length of 0 m was raised to 0.3: it can be 0.3 to 1.2 m."),
        ("step_length", 99.0, 1.2, "A step length of 99 m was lowered to 1.2: it can be 0.3 to 1.2 m."),
        ("heading", 370, 10.0, "A heading of 370 degrees is the same as 10."),
        ("facing", -540.0, -180.0, "A facing of -540 degrees is the same as "),
        ("facing", math.inf, None, "'inf' is no number"),
    ],
)
def test_what_cannot_be_is_brought_near_and_said_with_what_can(name, asked, held, text):
    orders, refusals = BOUNDS.changed(SteeringInputs(), {name: asked})
    value = getattr(orders, name)
    assert value == held or abs(value) == 180 == abs(held)
    [refusal] = refusals
    assert text in refusal.text
    assert refusal.held == value


def test_what_can_be_is_taken_as_it_is_without_a_word():
    orders, refusals = BOUNDS.changed(
        SteeringInputs(), {"speed": 2, "heading": -180, "facing": 90.5, "step_length": 0.8}
    )
    assert (orders, refusals) == (SteeringInputs(2.0, -180.0, 90.5, 0.8), [])
    orders, refusals = BOUNDS.changed(orders, {"facing": None, "step_length": None})
    assert (orders, refusals) == (SteeringInputs(2.0, -180.0), [])


def test_labels_are_of_the_prior_and_of_one_group_at_a_time():
    orders, refusals = BOUNDS.changed(SteeringInputs(), {"labels": {"gait": "run"}})
    orders, more = BOUNDS.changed(orders, {"labels": {"style": "old"}})
    assert (orders.labels, refusals + more) == ({"gait": "run", "style": "old"}, [])
    assert orders.command == Command(1.2, 0.0, labels=("gait=run", "style=old"))
    orders, refusals = BOUNDS.changed(orders, {"labels": {"gait": "swim", "mood": "bad"}})
    assert orders.labels == {"gait": "run", "style": "old"}
    assert refusals[0].text == "'swim' is not a gait that this prior knows."
    assert BOUNDS.changed(orders, {"labels": {"gait": UNCONDITIONED}})[0].labels == {"style": "old"}
