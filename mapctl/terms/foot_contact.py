"""Planted feet stay where they are, on the ground (rnn paper, Eq. 18)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import TOE_REST_HEIGHT, TOES
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class FootContact:
    """A toe that the prior calls planted does not travel and is at its rest height; no toe goes below it."""

    sigma_speed: float = 0.03
    """Horizontal speed of a planted toe, m/s."""
    sigma_height: float = 0.01
    """Height error of a planted toe, metres."""
    sigma_below: float = 0.005
    """Depth of any toe below its rest height, metres."""
    rest_height: float = TOE_REST_HEIGHT
    """Height of the toe joint while the foot stands flat, metres."""
    name: str = "footing"
    unit: str = "m/s"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats over both toes."""
        planted = self._planted(trial)
        energy = 0.5 * (planted * (self._speeds(trial) / self.sigma_speed).square()).sum(-1)
        above = self._heights(trial) - self.rest_height
        energy = energy + 0.5 * (trial.contacts * (above / self.sigma_height).square()).sum(-1)
        return energy + 0.5 * (above.clamp(max=0) / self.sigma_below).square().sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Horizontal speed of the faster planted toe, m/s; 0 where none is planted."""
        return (self._planted(trial) * self._speeds(trial)).amax(-1)

    def _toes(self, trial: Trial) -> list[int]:
        return trial.skeleton.indices(TOES)

    def _speeds(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        steps = torch.stack([trial.step(toe)[..., ::2] for toe in self._toes(trial)], dim=-2)
        return torch.sqrt(steps.square().sum(-1) + 1e-12) * trial.fps

    def _heights(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        return trial.joints_world[..., self._toes(trial), 1]

    def _planted(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        """A toe is held between two frames only if it is planted in both, the one before the window among them."""
        bits = trial.contacts
        past = trial.contacts_before.to(bits.device).expand(len(bits), 2).unsqueeze(1)
        before = torch.cat([past, bits[:, :-1]], dim=1)
        return (bits & before).to(trial.features.dtype)
