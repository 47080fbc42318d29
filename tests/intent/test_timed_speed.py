"""Speeds by time: zero is allowed, arcs are their integral."""

import pytest
import torch

from mapctl.errors import RequestError
from mapctl.intent.path import TimedSpeed


def test_arcs_are_the_integral_of_speeds():
    speed = TimedSpeed.parse(((0, 0), (1, 1.2), (3, 1.2), (4, 0)))
    arcs = speed.arcs(181, 30)
    torch.testing.assert_close(arcs[30], torch.tensor(0.6).double())
    torch.testing.assert_close(arcs[120], torch.tensor(0.6 + 2.4 + 0.6).double())
    torch.testing.assert_close(arcs[180], arcs[120])
    assert float(arcs[0]) == 0
    assert bool((arcs.diff() >= 0).all())


@pytest.mark.parametrize(
    ("seconds", "speeds"),
    [((), ()), ((0.0, 0.0), (1.0, 1.0)), ((1.0, 0.0), (1.0, 1.0)), ((0.0,), (-1.0,)), ((0.0,), (float("inf"),))],
)
def test_times_rise_and_speeds_are_not_negative(seconds, speeds):
    with pytest.raises(RequestError):
        TimedSpeed(seconds, speeds)
