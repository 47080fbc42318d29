"""Who drives a character live: a command that somebody last gave, or a path that somebody drew."""

import math
from dataclasses import replace

from controllers.steering.pure_pursuit import PurePursuit
from controllers.steering.steer import SteerFrames
from mapctl.curves.curve import Curve
from mapctl.intent.steering import Command, SteeringLimits

_ARRIVAL_DISTANCE = 0.15  # metres before the end of a path at which to stand


class Autopilot:
    """A Source, and the Display from which it knows where the character is."""

    def __init__(self, command: Command, limits: SteeringLimits):
        """`limits` tell how soon to brake before the end of a path."""
        self._command, self._limits = command, limits
        self._pursuit: PurePursuit | None = None
        self._last: SteerFrames | None = None

    def command(self, command: Command) -> None:
        """Obey this from now on."""
        self._command, self._pursuit = command, None

    def walk(self, curve: Curve, speed: float) -> None:
        """Go along a curve, in the steps, gait and style of the last command; to stand at an open one's end."""
        self._pursuit = PurePursuit(curve, speed=speed)
        if self._last is not None:
            self._pursuit.show(self._last, 0.0)

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        self._last = frames
        if self._pursuit is not None:
            self._pursuit.show(frames, due)

    def at(self, seconds: float) -> Command:
        """See Source."""
        if self._pursuit is None:
            return self._command
        wanted, left = self._pursuit.at(seconds), self._pursuit.left
        if left is not None:
            # As fast as can still be braked: v^2 = 2 a s.
            speed = min(wanted.speed, math.sqrt(2 * self._limits.braking * max(0.0, left - _ARRIVAL_DISTANCE)))
            if left <= _ARRIVAL_DISTANCE:
                self.command(Command(0.0, wanted.heading, told=self._command.told))
                return self._command
            wanted = Command(speed, wanted.heading)
        return replace(self._command, speed=wanted.speed, heading=wanted.heading, facing=None, turning=None)
