"""A body stands on what does not move: when a foot is near the ground, one that is near it stays where it is.

Unlike footing it asks nobody which toe is planted, so that a motion cannot slide by calling no toe planted at all.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.contacts import support_speed
from mapctl.skeleton import TOE_REST_HEIGHT, TOES
from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class Support:
    """Of the toes near the ground the slowest, on which the body stands, does not travel; flight costs nothing."""

    sigma: float = 0.1
    """Speed of that toe over the ground, m/s; mocap's planted toes move at 0.05."""
    rest_height: float = TOE_REST_HEIGHT
    """Height of the toe joint while the foot stands flat, metres."""
    name: str = "support"
    unit: str = "m/s"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats."""
        return 0.5 * (self._speed(trial) / self.sigma).square()

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Speed of what the body stands on, m/s; 0 in flight."""
        return self._speed(trial)

    def _speed(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        toes = trial.skeleton.indices(TOES)
        steps = torch.stack([torch.sqrt(trial.step(toe)[..., ::2].square().sum(-1) + 1e-12) for toe in toes], dim=-1)
        return support_speed(trial.joints_world[..., toes, 1] - self.rest_height, steps * trial.fps)
