"""Joints are where keys want them, in single frames or over some: hands that reach, feet that step on a mark."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Places in the world that joints are wanted at. Whole poses that are keys need no term: they are no unknowns."""

    places: Float[Tensor, "frames joints 3"]
    """World, metres; anything finite where no place is wanted."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a place is."""
    sigma: float = 0.002
    """Distance from it, metres."""
    name: str = "keyframe"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats, summed over joints."""
        return 0.5 * (self._squares(trial) / self.sigma**2).sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Distance of the joint that misses its place by most, metres; 0 where none is wanted."""
        return torch.sqrt(self._squares(trial).amax(-1))

    def _squares(self, trial: Trial) -> Float[Tensor, "batch frames joints"]:
        """Squared distances, m^2."""
        away = trial.joints_world - self.places.to(trial.features)
        return away.square().sum(-1) * self.wanted
