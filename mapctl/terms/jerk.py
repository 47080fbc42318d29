"""No pop where a window begins: accelerations run on across the seam."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class Jerk:
    """Jerk of the joints over the first frames of the window, measured together with the frames before it."""

    sigma: float = 400.0
    """Jerk, m/s^3: mocap walks at about 100 in the mean and several hundred at heel strike."""
    frames: int = 3
    """How many frames the seam reaches into the window."""
    name: str = "seam"
    unit: str = "m/s^3"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats, mean over joints; 0 beyond the seam and where there is no past."""
        return 0.5 * (self._jerk(trial) / self.sigma).square().mean(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Mean jerk over joints."""
        return self._jerk(trial).mean(-1)

    def _jerk(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        places, frames = trial.joints_world, min(self.frames, trial.joints_world.shape[1])
        jerk = places.new_zeros(places.shape[:3])
        if len(trial.before) < 3:
            return jerk
        past = trial.before[-3:].to(places.dtype).expand(len(places), -1, -1, -1)
        third = torch.diff(torch.cat([past, places[:, :frames]], dim=1), n=3, dim=1) * trial.fps**3
        third = torch.sqrt(third.square().sum(-1) + 1e-9)
        return torch.cat([third, jerk[:, frames:]], dim=1)
