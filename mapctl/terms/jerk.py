"""Jerk at the seam where a window begins: accelerations are continuous, so that nothing pops."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class Jerk:
    """The joints' jerk is small over the first frames of the window, taken together with the frames before it."""

    sigma: float = 400.0
    """Standard deviation of a joint's jerk, m/s^3: mocap walks at 100 in the mean, several hundred at heel strike."""
    frames: int = 3
    """Number of frames that the seam reaches into the window."""
    name: str = "seam"
    unit: str = "m/s^3"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats, mean over joints; 0 beyond the seam and with fewer than three frames before the
        window."""
        return 0.5 * (self._jerk(trial) / self.sigma).square().mean(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the mean jerk over joints, m/s^3."""
        return self._jerk(trial).mean(-1)

    def _jerk(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        positions, frames = trial.joints_world, min(self.frames, trial.joints_world.shape[1])
        jerk = positions.new_zeros(positions.shape[:3])
        if len(trial.before) < 3:
            return jerk
        past = trial.before[-3:].to(positions.dtype).expand(len(positions), -1, -1, -1)
        third = torch.diff(torch.cat([past, positions[:, :frames]], dim=1), n=3, dim=1) * trial.fps**3
        third = torch.sqrt(third.square().sum(-1) + 1e-9)
        return torch.cat([third, jerk[:, frames:]], dim=1)
