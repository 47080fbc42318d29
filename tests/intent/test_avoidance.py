"""Directions that lead round obstacles."""

import math

import numpy as np
import pytest
import torch

from controllers.steering.steer import lead_around
from mapctl.curves.obstacles import Obstacle, measure_clearance

AHEAD = dict(position=(0.0, 0.0), heading=0.0, wanted=0.0, speed=1.2)


def walked(obstacles, wanted=0.0, *, frames=240, speed=1.2, at=(0.0, 0.0)):
    """Places of a point that goes where it is led, turning at most 2.5 rad/s."""
    position, heading, found = np.array(at), wanted, []
    for _ in range(frames):
        led = lead_around(obstacles, position=tuple(position), heading=heading, wanted=wanted, speed=speed)
        heading += np.clip(math.remainder(led - heading, 2 * math.pi), -2.5 / 30, 2.5 / 30)
        position = position + speed / 30 * np.array([math.sin(heading), math.cos(heading)])
        found.append(position)
    return np.array(found)


@pytest.mark.parametrize(
    "obstacles",
    [
        (Obstacle((0.0, 3.0), 0.5),),
        (Obstacle((0.2, 3.0), 1.0),),
        (Obstacle((0.0, 3.0), size=(2.0, 0.4), turn_deg=20.0),),
        (Obstacle((-0.5, 3.0), 0.5), Obstacle((0.6, 3.5), 0.5)),
    ],
)
def test_a_point_gets_past_and_goes_on_as_wanted(obstacles):
    way = walked(obstacles)
    assert float(measure_clearance(obstacles, torch.from_numpy(way)).min()) > 0.25
    assert way[-1, 1] > 6.5
    last = np.diff(way[-10:], axis=0)
    assert np.abs(np.arctan2(last[:, 0], last[:, 1])).max() < 0.05


def test_a_walker_passing_on_one_side_is_led_past_it():
    ahead = (Obstacle((0.0, 2.0), 0.5),)
    for heading in (0.5, -0.5):
        led = lead_around(ahead, position=(0.0, 0.0), heading=heading, wanted=0.0, speed=1.2)
        assert led * heading > 0
