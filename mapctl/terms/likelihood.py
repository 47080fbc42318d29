"""The prior's density of the motion (Wang et al. 2019, Eq. 15)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mapctl.terms.adjoints.gradient import TrialGradient
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class Likelihood:
    """Minus the log density of each frame given those before it, divided by a temperature."""

    temperature: float = 1.0
    """Factor by which log densities are divided; above 1 the prior counts less."""
    name: str = "likelihood"
    """Name in the ledger."""
    unit: str = "nats"
    """Unit of the residual."""

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats; negative where the density is above 1."""
        return -trial.require_log_density() / self.temperature

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        gradient.log_density[...] -= 1 / self.temperature
        return -trial.require_log_density().double().numpy() / self.temperature

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return minus the log density, nats."""
        return -trial.require_log_density()
