"""The Gaussian prior of the noise (rnn paper, Eq. 16)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class LatentPrior:
    """Noise is small: latents of a rollout have sigma 1, noise on the network's input the paper's 0.05."""

    sigma: float = 1.0
    """Standard deviation of each number."""
    name: str = "noise"
    unit: str = "rms"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Half the squared numbers of each frame over sigma squared."""
        return 0.5 * (trial.require_noise() / self.sigma).square().sum(-1)

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Root mean square of a frame's numbers."""
        return trial.require_noise().square().mean(-1).sqrt()
