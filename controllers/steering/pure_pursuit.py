"""Walk a curve live: a source that heads for the point of the curve a little ahead of where the character is.

Pure pursuit, for curves that are not known in advance or change; `controllers.follow` is more exact where
they are.
"""

import math

import torch

from controllers.steering.steer import SteerFrames
from mapctl.curves.curve import Curve
from mapctl.intent.steering import Command

_SEARCH_BACKWARD, _SEARCH_FORWARD, _SEARCH_POINTS = (
    0.1,
    0.5,
    61,
)  # metres around the last nearest arc that are searched for the next, and how finely


class PurePursuit:
    """A Source, and the Display from which it knows where the character is. Closed curves go round and round."""

    def __init__(self, curve: Curve, *, speed: float, look_ahead: float = 0.5):
        """`speed` in m/s along the curve; `look_ahead` in metres: less holds the curve tighter and sways more."""
        self.curve, self.speed, self.look_ahead = curve, speed, look_ahead
        self.arc = 0.0
        self.place = self._point(0.0)

    @property
    def first(self) -> Command:
        """What to begin with, at the curve's first point."""
        return Command(self.speed, self.curve.start_heading)

    @property
    def left(self) -> float | None:
        """Metres to the end of an open curve from where the character was last nearest to; None on a closed one."""
        return None if self.curve.closed else self.curve.length - self.arc

    def show(self, frames: SteerFrames, due: float) -> None:
        """See Display."""
        self.place = frames.motion.root_position[-1, ::2]

    def at(self, seconds: float) -> Command:
        """See Source."""
        arcs = torch.linspace(
            self.arc - _SEARCH_BACKWARD, self.arc + _SEARCH_FORWARD, _SEARCH_POINTS, dtype=torch.float64
        ).tolist()
        distances = torch.stack([(self._point(arc) - self.place).norm() for arc in arcs])
        self.arc = arcs[int(distances.argmin())]
        way = self._point(self.arc + self.look_ahead) - self.place
        return Command(self.speed, math.atan2(float(way[0]), float(way[1])))

    def _point(self, arc: float) -> torch.Tensor:
        """x and z, float64, metres."""
        return self.curve.point(arc)[[0, -1]].double()
