"""Speeds along a path: corners are slowed for in time, reversals are found, arcs are the integral of speed."""

import numpy as np
import pytest
import torch

from mapctl import curves
from mapctl.errors import RequestError
from mapctl.intent.path import USUAL_SPEED, TimedSpeed, find_reversals, walk_at_ease


def polygon(*points, closed=False):
    return curves.from_points(np.array(points, dtype=float), closed=closed)


@pytest.mark.parametrize("shape", ["line:5", "circle:1", "circle:4", "wave:0.8x8", "figure8:1.5", "s:8"])
def test_gentle_curves_are_walked_at_the_usual_speed_throughout(shape):
    assert walk_at_ease(curves.read(shape)).speeds == (USUAL_SPEED,)


@pytest.mark.parametrize("degrees", [90, 130, -90])
def test_a_corner_is_slowed_for_in_time_and_left_again(degrees):
    turn = np.radians(degrees)
    curve = polygon((0, 0), (0, 4), (4 * np.sin(turn), 4 + 4 * np.cos(turn)))
    profile = walk_at_ease(curve)
    assert 0.69 < profile.at(4.0) < 0.72
    assert profile.at(1.0) == profile.at(7.0) == 1.2
    arcs = np.arange(0.0, 8.0, 0.05)
    squares = np.array([profile.at(arc) for arc in arcs]) ** 2
    assert np.abs(np.diff(squares)).max() / (2 * 0.05) < 0.95, "braking and setting off, m/s^2"


def test_reversals_are_found_where_they_are_and_hairpins_are_none():
    there = find_reversals(polygon((0, 0), (0, 4), (0, 1), (2, 1)))
    assert there == pytest.approx([4.0], abs=0.05)
    assert find_reversals(polygon((0, 0), (0, 4), (0.5, 4), (0.5, 0))) == []
    assert find_reversals(curves.read("figure8:1.5")) == []


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
