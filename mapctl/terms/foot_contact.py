"""Foot contact: planted feet do not move and are on the ground (Wang et al. 2019, Eq. 18)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import TOE_REST_HEIGHT
from mapctl.terms.adjoints import kernels
from mapctl.terms.adjoints.gradient import TrialGradient
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class FootContact:
    """A toe whose contact bit is set does not travel and is at its rest height; no toe goes below it."""

    sigma_speed: float = 0.03
    """Standard deviation of the horizontal speed of a planted toe, m/s."""
    sigma_height: float = 0.01
    """Standard deviation of the height of a planted toe about its rest height, metres."""
    sigma_below: float = 0.005
    """Standard deviation of the depth of any toe below its rest height, metres."""
    rest_height: float = TOE_REST_HEIGHT
    """Height of the toe joint while the foot is flat on the ground, metres."""
    name: str = "footing"
    unit: str = "m/s"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Energies of both toes, nats."""
        energy = 0.5 * (self._planted(trial) * (trial.toe_speeds / self.sigma_speed).square()).sum(-1)
        above = trial.toe_heights - self.rest_height
        energy = energy + 0.5 * (trial.contacts * (above / self.sigma_height).square()).sum(-1)
        return energy + 0.5 * (above.clamp(max=0) / self.sigma_below).square().sum(-1)

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """See DifferentiatedTerm."""
        energy = np.empty(gradient.log_density.shape)
        kernels.add_foot_contact(
            trial.joints_world.numpy(),
            trial.last_before.numpy(),
            trial.contacts.numpy(),
            trial.contacts_before.expand(len(energy), 2).numpy(),
            trial.toes,
            float(trial.fps),
            (self.sigma_speed, self.sigma_height, self.sigma_below),
            self.rest_height,
            energy,
            gradient.joints_world,
        )
        return energy

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Horizontal speed of the faster planted toe, m/s; 0 where none is planted."""
        return (self._planted(trial) * trial.toe_speeds).amax(-1)

    def _planted(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        """1 where a toe is planted in a frame and in the one before it, be that before the window; else 0."""
        planted = trial.planted
        return (planted[:, 1:] & planted[:, :-1]).to(trial.features.dtype)
