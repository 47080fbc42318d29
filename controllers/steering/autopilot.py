"""Source of a live character's commands: the last command given, or the path last drawn."""

import math
from dataclasses import replace

from controllers.steering.pure_pursuit import PurePursuit
from controllers.steering.steer import SteerFrames
from mapctl.curves.curve import Curve
from mapctl.intent.steering import Arrival, Command
from mapctl.intent.steering_limits import SteeringLimits

_ARRIVAL_DISTANCE = 0.15  # metres before the end of a path at which the character stops


class Autopilot:
    """A Source, and the Display from which it gets the character's position."""

    def __init__(self, command: Command, limits: SteeringLimits):
        """Begin with a command; `limits` determine how soon to brake before the end of a path."""
        self._command, self._limits = command, limits
        self._pursuit: PurePursuit | None = None
        self._goal: Arrival | None = None  # its time counted from when it is asked for
        self._last: SteerFrames | None = None

    def command(self, command: Command) -> None:
        """Hold this command from now on."""
        self._command, self._pursuit, self._goal = command, None, None

    def go(self, command: Command, place: tuple[float, float], within: float, facing: float | None) -> None:
        """Be at a `place` (x and z, metres) `within` so many seconds from the next step on, `facing` so (radians), and
        hold the command from then on."""
        self.command(command)
        self._goal = Arrival(place, within, facing)

    def stay(self) -> None:
        """Go to no place any more."""
        self._command, self._goal = replace(self._command, arrival=None), None

    def aim(self, command: Command) -> None:
        """Reach, look and walk round obstacles as this command says; nothing else of it counts."""
        self._command = replace(
            self._command, reach=command.reach, look_at=command.look_at, obstacles=command.obstacles
        )

    def walk(self, curve: Curve, speed: float) -> None:
        """Walk along a curve at a `speed` in m/s, with the step length and labels of the last command; stop at the end
        of an open one."""
        self._pursuit, self._goal = PurePursuit(curve, speed=speed), None
        self._command = replace(self._command, arrival=None)
        if self._last is not None:
            self._pursuit.show(self._last, 0.0)

    def show(self, frames: SteerFrames, due: float) -> None:
        """Keep where the character is; when its frames are `due` (seconds of the stream) does not matter."""
        self._last = frames
        if self._pursuit is not None:
            self._pursuit.show(frames, due)

    def at(self, seconds: float) -> Command:
        """Return the command that holds now, at so many seconds of the stream."""
        if self._goal is not None:
            self._command = replace(self._command, arrival=replace(self._goal, by=seconds + self._goal.by))
            self._goal = None
        if self._pursuit is None:
            return self._command
        pursued, left = self._pursuit.at(seconds), self._pursuit.left
        if left is not None:
            # The highest speed from which braking stops in time: v^2 = 2 a s.
            speed = min(pursued.speed, math.sqrt(2 * self._limits.braking * max(0.0, left - _ARRIVAL_DISTANCE)))
            if left <= _ARRIVAL_DISTANCE:
                self.command(
                    replace(
                        self._command, speed=0.0, heading=pursued.heading, facing=None, turning=None, step_length=None
                    )
                )
                return self._command
            pursued = Command(speed, pursued.heading)
        return replace(self._command, speed=pursued.speed, heading=pursued.heading, facing=None, turning=None)
