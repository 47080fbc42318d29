"""Source of commands: the last command, or a drawn path until it ends."""

from itertools import pairwise

import pytest
import torch
from helpers import walk

from controllers.steering.process import Autopilot
from controllers.steering.steer import SteerFrames
from mapctl import curves
from mapctl.intent.steering import Command, SteeringLimits
from mapctl.motion import Motion
from mapctl.problem.solution import Ledger, Outcome, Status

LINE = curves.from_points(torch.tensor([[0.0, 0.0], [0.0, 5.0]]))


def at_place(pilot: Autopilot, x: float, z: float) -> None:
    """The character was shown there."""
    pose = walk(2).slice(0, 1)
    moved = Motion(pose.skeleton, pose.fps, torch.tensor([[x, 0.9, z]], dtype=torch.float64), pose.local_quat_xyzw)
    pilot.show(
        SteerFrames(
            moved,
            Status(Outcome.DONE),
            Ledger(),
            contacts=torch.zeros(1, 2),
            root_velocity=torch.zeros(1, 2),
            steering_targets=(),
            forecast=torch.zeros(0, 21, 3),
        ),
        0.0,
    )


@pytest.mark.slow
def test_a_path_is_walked_braked_for_and_stood_at():
    pilot = Autopilot(Command(1.0, 0.5, labels=("elderly",)), SteeringLimits(braking=2.0))
    at_place(pilot, 0.0, 0.0)
    pilot.walk(LINE, 1.4)
    speeds = []
    for step in range(51):
        at_place(pilot, 0.0, 0.1 * step)
        speeds.append(pilot.at(0.0).speed)
        assert pilot.at(0.0).labels == ("elderly",), "the labels of the command stay"
    assert speeds[0] == 1.4
    assert all(b <= a + 1e-9 for a, b in pairwise(speeds))
    assert speeds[-1] == 0.0
    assert pilot.at(0.0).heading == pytest.approx(0.0, abs=0.1)


def test_an_order_to_be_somewhere_counts_its_seconds_from_the_next_step_and_stays_one_order():
    pilot = Autopilot(Command(1.0, 0.0), SteeringLimits())
    pilot.go(Command(0.5, 0.2), (1.0, 2.0), 1.5, 0.3)
    command = pilot.at(4.0)
    assert (command.speed, command.arrival.position, command.arrival.by) == (0.5, (1.0, 2.0), 5.5)
    assert pilot.at(4.1).arrival is command.arrival
    pilot.aim(Command(0.0, 0.0, look_at=(1.0, 1.0, 1.0)))
    assert pilot.at(4.2).arrival is command.arrival
    pilot.command(Command(1.0, 0.0))
    assert pilot.at(4.3).arrival is None
    pilot.go(Command(0.5, 0.2), (1.0, 2.0), 1.5, None)
    pilot.stay()
    assert pilot.at(5.0).arrival is None
    pilot.go(Command(0.5, 0.2), (1.0, 2.0), 1.5, None)
    pilot.walk(LINE, 1.0)
    assert pilot.at(5.0).arrival is None
