"""How fast a steering target may change."""

import math
from dataclasses import dataclass

from mapctl.errors import RequestError


@dataclass(frozen=True)
class SteeringLimits:
    """Limits on the rate of change of the target; a jump in the command becomes the fastest change that these allow."""

    acceleration: float = 2.0
    """Largest rise of the speed, m/s^2."""
    braking: float = 2.0
    """Largest fall of the speed, m/s^2."""
    turn_rate: float = 2.5
    """Largest turn rate of the direction, radians/s. More than the one-second means of a walk's data show
    (`DataLimits.turn_rate`): a reversal has to be faster."""

    def __post_init__(self):
        for name in ("acceleration", "braking", "turn_rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise RequestError(f"{name} must be positive, got {getattr(self, name):g}")
