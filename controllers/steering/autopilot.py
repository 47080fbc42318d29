"""Sources of commands: pure pursuit of a curve, and what a live character obeys: the last command or drawn path.

Pure pursuit is for curves that are not known in advance or change; `controllers.follow` is more exact.
"""

import math
from dataclasses import replace

import torch

from controllers.steering.steer import SteerFrames
from mapctl.curves.curve import Curve
from mapctl.intent.steering import Arrival, Command, SteeringLimits

_ARRIVAL_DISTANCE = 0.15  # metres before the end of a path at which the character stops
_SEARCH_BACKWARD, _SEARCH_FORWARD = 0.1, 0.5  # metres around the last nearest arc in which the next is searched
_SEARCH_POINTS = 61


class PurePursuit:
    """A Source, and the Display from which it gets the character's position. Closed curves have no end."""

    def __init__(self, curve: Curve, *, speed: float, look_ahead: float = 0.5):
        """Begin at the curve's start; `speed` in m/s; `look_ahead` in metres: less tracks closer and sways more."""
        self.curve, self.speed, self.look_ahead = curve, speed, look_ahead
        self.arc = 0.0
        self.position = self._point(0.0)

    @property
    def first(self) -> Command:
        """First command, at the curve's first point."""
        return Command(self.speed, self.curve.start_heading)

    @property
    def left(self) -> float | None:
        """Arc left from the point last nearest to the character to the end of an open curve, metres; None on a closed
        one."""
        return None if self.curve.closed else self.curve.length - self.arc

    def show(self, frames: SteerFrames, due: float) -> None:
        """Keep where the character is; when its frames are `due` (seconds of the stream) does not matter."""
        self.position = frames.motion.root_position[-1, ::2]

    def at(self, seconds: float) -> Command:
        """Return the command towards the point ahead of the character; how many seconds of the stream have passed does
        not matter."""
        first, last = self.arc - _SEARCH_BACKWARD, self.arc + _SEARCH_FORWARD
        arcs = torch.linspace(first, last, _SEARCH_POINTS, dtype=torch.float64).tolist()
        distances = torch.stack([(self._point(arc) - self.position).norm() for arc in arcs])
        self.arc = arcs[int(distances.argmin())]
        direction = self._point(self.arc + self.look_ahead) - self.position
        return Command(self.speed, math.atan2(float(direction[0]), float(direction[1])))

    def _point(self, arc: float) -> torch.Tensor:
        """Return x and z of the curve at an arc, float64, metres."""
        return self.curve.point(arc)[[0, -1]].double()


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
