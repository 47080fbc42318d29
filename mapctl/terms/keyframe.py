"""Keyframes: joints at target positions in single frames or over some: hands that reach, feet that step on a mark."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Joints are at target positions in the world. Whole poses that are given need no term: they are no unknowns."""

    positions: Float[Tensor, "frames joints 3"]
    """Target positions in the world, metres; anything finite where there is no target."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a joint has a target in a frame."""
    sigma: float = 0.002
    """Standard deviation of a joint about its target along each axis, metres."""
    name: str = "keyframe"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats, summed over joints."""
        return 0.5 * (self._squares(trial) / self.sigma**2).sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the distance of the joint that is farthest from its target, metres; 0 where there is none."""
        return torch.sqrt(self._squares(trial).amax(-1))

    def _squares(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        """Squared distances, m^2."""
        error = trial.joints_world - self.positions.to(trial.features)
        return error.square().sum(-1) * self.wanted
