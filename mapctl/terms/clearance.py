"""A toe that travels is off the ground: what neither stands nor clears it skates."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import TOE_REST_HEIGHT, TOES
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Clearance:
    """Toes that are not planted are the higher over the ground the faster they go, up to what most walking people
    clear.
    """

    height: float = 0.035
    """Of a toe that swings, over its rest height, metres: less costs."""
    speed: float = 1.0
    """From which that much is asked for, m/s; in proportion below."""
    sigma: float = 0.015
    """What lacks, metres."""
    rest_height: float = TOE_REST_HEIGHT
    """Height of the toe joint while the foot stands flat, metres."""
    share: Float[Tensor, "frames 2"] | None = None
    """Of the height that each toe is to clear in each frame of the window, 0 to 1; all of it for None."""
    name: str = "clearance"
    unit: str = "m"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats over both toes."""
        return 0.5 * (self._height_deficit(trial) / self.sigma).square().sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """By how much the lower toe is too low, metres; 0 where none is."""
        return self._height_deficit(trial).amax(-1)

    def _height_deficit(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        toes = trial.skeleton.indices(TOES)
        speeds = torch.stack([torch.sqrt(trial.step(toe)[..., ::2].square().sum(-1) + 1e-12) for toe in toes], dim=-1)
        wanted = self.height * (speeds * trial.fps / self.speed).clamp(max=1)
        if self.share is not None:
            wanted = wanted * self.share.to(wanted)
        above = trial.joints_world[..., toes, 1] - self.rest_height
        return torch.where(trial.contacts, 0.0, (wanted - above).clamp_min(0))
