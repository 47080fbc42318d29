"""Pure pursuit: live commands that head for the point of a curve a little ahead of the character.

For curves that are not known in advance or change; `controllers.follow` is more exact where they are known.
"""

import math

import torch

from controllers.steering.steer import SteerFrames
from mapctl.curves.curve import Curve
from mapctl.intent.steering import Command

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
