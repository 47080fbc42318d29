"""The prior's density of the motion (Wang et al. 2019, Eq. 15)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mapctl.terms.base import TrialGradient
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class Likelihood:
    """Minus the log density of each frame given those before it, divided by a temperature."""

    temperature: float = 1.0
    """Factor by which log densities are divided; above 1 the prior counts less."""
    name: str = "likelihood"
    unit: str = "nats"

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


@dataclass(frozen=True, eq=False)
class LatentPrior:
    """The trial's noise is normal: latents of a rollout, input noise or pose offsets."""

    sigma: float = 1.0
    """Standard deviation of each number, in units of the noise, whose own is 1; above 1 leaves more of it."""
    centre: Float[Tensor, "frames width"] | None = None
    """Mean of each frame of the window; None is 0. A draw, with the most probable motion about it, is a sample of the
    posterior (perturb and MAP, Papandreou and Yuille 2011)."""
    name: str = "noise"
    unit: str = "rms"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies, nats: half the squared numbers of each frame over sigma squared."""
        return 0.5 * (self._deviate(trial) / self.sigma).square().sum(-1)

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        away = self._deviate(trial).double().numpy() / self.sigma
        gradient.noise[...] += away / self.sigma
        return 0.5 * np.square(away).sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the root mean square of a frame's numbers."""
        return self._deviate(trial).square().mean(-1).sqrt()

    def _deviate(self, trial: Trial) -> Float[Tensor, "batch frames width"]:
        noise = trial.require_noise()
        return noise if self.centre is None else noise - self.centre.to(noise)
