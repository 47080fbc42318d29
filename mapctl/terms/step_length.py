"""Step length: the distance of a foot that comes down from the other one (Wang et al. 2019, section 5.3)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import TOES
from mapctl.terms import kernels
from mapctl.terms.base import TrialGradient
from mapctl.terms.trial import Trial

_NEVER = -2  # below every frame


@dataclass(frozen=True)
class StepLength:
    """A toe that touches down is at a target distance from where the other one was last planted.

    Touch-downs are those of the prior's contact bits, as in foot contact. One after which the other toe was last
    planted before the window counts only if that was in the frame just before it.
    """

    length: float
    """Target distance over the ground, metres."""
    sigma: float = 0.012
    """Standard deviation of a step's length, metres: small, since few frames of a window are touch-downs."""
    name: str = "steps"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies in the frames of touch-downs, nats; 0 in all others."""
        return 0.5 * (self._length_error(trial) / self.sigma).square()

    def add_gradient(self, trial: Trial, gradient: TrialGradient) -> Float[np.ndarray, "batch frames"]:
        """Add the gradient of the summed energies of a float32 trial, and return the energies, nats."""
        energy = np.empty(gradient.log_density.shape)
        feet = (each.numpy() for each in (trial.joints_world, trial.last_before, trial.planted))
        kernels.add_step_length(*feet, trial.toes, self.length, self.sigma, energy, gradient.joints_world)
        return energy

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the error of the step length, metres; 0 between touch-downs."""
        return self._length_error(trial).abs()

    def _length_error(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        errors = torch.zeros_like(trial.features[..., 0])
        toes = trial.joints_world[..., trial.skeleton.indices(TOES), ::2]
        if len(trial.before):
            feet = trial.before[-1, trial.skeleton.indices(TOES), ::2].to(toes.dtype)
            toes = torch.cat([feet.expand(len(toes), 1, 2, 2), toes], dim=1)
        shift = int(len(trial.before) > 0)
        row, frame, foot, last = _find_touch_downs(trial)
        apart = toes[row, frame + shift, foot] - toes[row, last + shift, 1 - foot]
        lengths = torch.sqrt(apart.square().sum(-1) + 1e-12)
        return errors.index_put((row, frame), lengths - self.length, accumulate=True)


def _find_touch_downs(trial: Trial) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Batch row, frame and foot of each touch-down, and the frame in which the other foot was last planted; -1 is the
    frame before the window."""
    planted = trial.planted
    known = planted.clone()
    known[:, 0] &= len(trial.before) > 0  # else its position is not known
    frames = torch.arange(-1, planted.shape[1] - 1)[:, None]
    last = torch.where(known, frames, _NEVER).cummax(dim=1).values[:, 1:].flip(-1)
    row, frame, foot = (planted[:, 1:] & ~planted[:, :-1] & (last > _NEVER)).nonzero().unbind(-1)
    return row, frame, foot, last[row, frame, foot]
