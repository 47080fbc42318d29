"""Budgets are kept exactly, by count and by clock."""

from hypothesis import given
from hypothesis import strategies as st

from mapctl.solver.budget import Budget, Meter


class Clock:
    """A clock that stands still until told."""

    def __init__(self):
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@given(limit=st.integers(0, 40), requests=st.lists(st.integers(1, 9), max_size=30))
def test_exactly_what_fits_is_granted(limit: int, requests: list[int]):
    meter, granted = Meter(Budget(evaluations=limit)), 0
    for count in requests:
        fits = granted + count <= limit
        assert meter.take(count) is fits
        granted += count if fits else 0
    assert (meter.evaluations, meter.remaining) == (granted, limit - granted)
    assert meter.exhausted is (granted == limit)
    assert bool(meter.reason) is meter.exhausted


def test_deadline_counts_from_the_making_of_the_meter_and_refuses_at_it():
    clock = Clock()
    meter = Meter(Budget(seconds=0.5), clock=clock)
    clock.now += 0.4375
    assert meter.take(1000)
    assert not meter.exhausted
    assert meter.seconds == 0.4375
    clock.now += 0.0625
    assert not meter.take()
    assert meter.exhausted
    assert meter.remaining == 0
    assert (meter.evaluations, meter.reason) == (1000, "used its 0.5 s")


def test_the_least_is_granted_after_the_deadline_and_no_more_than_all():
    clock = Clock()
    meter = Meter(Budget(evaluations=5, seconds=1.0, least=3), clock=clock)
    clock.now += 2.0
    assert (meter.remaining, meter.exhausted) == (3, False)
    assert [meter.take() for _ in range(5)] == [True, True, True, False, False]
    assert (meter.remaining, meter.reason) == (0, "used its 1 s")
    small = Meter(Budget(evaluations=2, seconds=0.0, least=3), clock=clock)
    assert [small.take() for _ in range(3)] == [True, True, False]


def test_an_evaluation_that_would_end_too_late_is_not_begun():
    now = [0.0]
    meter = Meter(Budget(seconds=1.0, evaluation_seconds=0.3), clock=lambda: now[0])
    for took in (0.3, 0.3, 0.1):
        assert meter.take()
        now[0] += took
    assert meter.take(), "the last one took 0.1 s, and 0.3 s are left"
    now[0] += 0.25
    assert meter.exhausted
    assert meter.remaining == 0
    assert not meter.take()
    assert meter.evaluations == 4
    assert not Meter(Budget(seconds=0.2, evaluation_seconds=0.3), clock=lambda: now[0]).take()
    assert not Meter(Budget(seconds=1.0, evaluation_seconds=0.3), clock=lambda: now[0]).take(4)
    assert Meter(Budget(seconds=1.0, evaluation_seconds=0.3), clock=lambda: now[0]).take(3)
    assert Meter(Budget(seconds=0.2), clock=lambda: now[0]).take(), "what is not known is not expected"
