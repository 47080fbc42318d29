"""A script whose commands other programs change over OSC while it is played."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from controllers.steering.autopilot import Autopilot
from controllers.steering.steer import SteerFrames
from mapctl import curves
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.intent.steering import Command, CommandTrack
from mapctl.intent.steering_limits import SteeringLimits
from mapctl.streaming.protocols import MessageSource
from scenes.live.inputs import InputLimits, Refusal, SteeringInputs
from scenes.live.remote.orders import RemoteOrders

_DEFAULT_SPEED = 1.2  # m/s of a path for who stands


class RemoteScript:
    """A Source: the script's last line, as changed by orders since it came; the next line ends what they said.

    It is the only character that orders are for, and the Display from which paths are followed.
    """

    def __init__(self, track: CommandTrack, source: MessageSource, bounds: InputLimits, limits: SteeringLimits):
        """`bounds` are what can be asked of the prior, and `limits` how fast a target may change."""
        self._track, self._bounds = track, bounds
        self._pilot = Autopilot(track.commands[0], limits)
        self._follow(track.commands[0])
        self._remote = RemoteOrders(source, self, [self], groups=list(bounds.labels))
        self.notes: list[str] = []

    def at(self, seconds: float) -> Command:
        """See Source."""
        line = self._track.at(seconds)
        if line is not self._line:
            self._follow(line)
        self._remote.obey()
        if (said := self._remote.report(time.perf_counter())) is not None:
            self.notes.append(said)
        return self._pilot.at(seconds)

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        self._pilot.show(frames, due)

    def change(self, member: "RemoteScript", changes: Mapping[str, Any]) -> list[Refusal]:
        """See RemoteStage."""
        self.orders, refusals = self._bounds.changed(self.orders, changes)
        if "heading" in changes:
            self._turning = None
        self._pilot.command(self._command)
        return refusals

    def aim(self, member: "RemoteScript") -> None:
        """See RemoteStage."""
        self._pilot.aim(self._command)

    def go(self, member: "RemoteScript", place: tuple[float, float], within: float, facing: float | None) -> None:
        """See RemoteStage."""
        self._pilot.go(self._command, place, within, facing)

    def walk(self, member: "RemoteScript", points: Sequence[tuple[float, float]]) -> None:
        """See RemoteStage."""
        speed = min(self.orders.speed or _DEFAULT_SPEED, self._bounds.fastest)
        self._pilot.walk(curves.through(np.array(points, dtype=np.float64)), speed)

    def set_disc(self, disc: Obstacle | None) -> None:
        """See RemoteStage. The script's own obstacles stay."""
        self._disc = () if disc is None else (disc,)
        self._pilot.aim(self._command)

    def set_paused(self, paused: bool) -> None:
        """See RemoteStage."""
        raise RequestError("pause is for mapctl live; a script has none")

    def restart(self) -> None:
        """See RemoteStage."""
        raise RequestError("reset is for mapctl live; a script has none")

    @property
    def _command(self) -> Command:
        obstacles = (*self._line.obstacles, *self._disc)
        return replace(self.orders.command, turning=self._turning, obstacles=obstacles)

    def _follow(self, line: Command) -> None:
        self._line, self._turning, self._disc = line, line.turning, ()
        self.orders = _to_inputs(line, self._bounds.labels)
        self._pilot.command(line)


def _to_inputs(line: Command, labels: Mapping[str, Sequence[str]]) -> SteeringInputs:
    """Return a line of the script as orders that can be changed."""
    return SteeringInputs(
        line.speed,
        math.degrees(line.heading),
        None if line.facing is None else math.degrees(line.facing),
        line.step_length,
        {group: word for word in line.labels for group, known in labels.items() if word in known},
        reach={joint.removesuffix("Hand"): place for joint, place in line.reach.items()},
        look_at=line.look_at,
    )
