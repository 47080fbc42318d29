"""Steering that searches little, with an untrained density."""

from helpers import generator, tiny_density

from controllers.steering import steer
from controllers.steering.steer import SteerSettings
from mapctl.intent.steering import Command

DENSITY = tiny_density()
QUICK = SteerSettings(horizon=8, commit=3, evaluations=4, least_evaluations=2)
AHEAD = Command(1.2, 0.0)


def begun(command=AHEAD, *, seed=0, settings=QUICK):
    return steer.begin(DENSITY, command, generator=generator(seed), settings=settings)
