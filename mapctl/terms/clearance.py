"""Swing clearance: a toe that travels is off the ground; one that is neither planted nor clear of it skates."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.skeleton import TOE_REST_HEIGHT
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Clearance:
    """Toes that are not planted are the higher over the ground the faster they travel, up to the usual clearance of
    walking people."""

    height: float = 0.035
    """Clearance of a toe in full swing over its rest height, metres: less costs."""
    speed: float = 1.0
    """Speed over the ground from which all of `height` is wanted, m/s; below, in proportion."""
    sigma: float = 0.015
    """Standard deviation of the height that is lacking, metres."""
    rest_height: float | Float[Tensor, "frames 2"] = TOE_REST_HEIGHT
    """Height of the toe joint while the foot is flat on the ground, metres; of each toe's in each frame, if not one."""
    share: Float[Tensor, "frames 2"] | None = None
    """Share of the height that each toe is to clear in each frame of the window, 0 to 1; None: all of it."""
    name: str = "clearance"
    """Name in the ledger."""
    unit: str = "m"
    """Unit of the residual."""

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the energies of both toes, nats."""
        return 0.5 * (self._height_deficit(trial) / self.sigma).square().sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Return the height that the lower toe is lacking, metres; 0 where none is."""
        return self._height_deficit(trial).amax(-1)

    def _height_deficit(self, trial: Trial) -> Float[Tensor, "batch frames 2"]:
        wanted = self.height * (trial.toe_speeds / self.speed).clamp(max=1)
        if self.share is not None:
            wanted = wanted * self.share.to(wanted)
        lacking = wanted - (trial.toe_heights - self.rest_height)
        return torch.where(trial.contacts, 0.0, lacking.clamp_min(0))
