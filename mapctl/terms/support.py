"""Support: while a foot is near the ground, one that is near it does not move.

Unlike foot contact it does not depend on contact bits, so a motion cannot slide by leaving every toe unplanted.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mapctl.contacts import support_speed
from mapctl.skeleton import TOE_REST_HEIGHT
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Support:
    """The slowest of the toes near the ground, which supports the body, does not travel; flight costs nothing."""

    sigma: float = 0.1
    """Standard deviation of that toe's speed over the ground, m/s; mocap's planted toes move at 0.05."""
    rest_height: float | Float[Tensor, "frames 2"] = TOE_REST_HEIGHT
    """Height of the toe joint while the foot is flat on the ground, metres; of each toe's in each frame, if not one."""
    name: str = "support"
    """Name in the ledger."""
    unit: str = "m/s"
    """Unit of the residual."""

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats."""
        return 0.5 * (self._speed(trial) / self.sigma).square()

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the speed of the supporting toe over the ground, m/s; 0 in flight."""
        return self._speed(trial)

    def _speed(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        return support_speed(trial.toe_heights - self.rest_height, trial.toe_speeds)
