"""The prior's own density of the motion (rnn paper, Eq. 15)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mapctl.terms.trial import Trial


@dataclass(frozen=True)
class Likelihood:
    """Minus the log density of each frame given those before it, divided by a temperature."""

    temperature: float = 1.0
    """Above 1 the prior is trusted less."""
    name: str = "likelihood"
    unit: str = "nats"

    def __call__(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """Nats; may be negative, since densities may pass 1."""
        return -trial.require_log_density() / self.temperature

    def residual(self, trial: Trial) -> Float[Tensor, "batch frames"]:
        """The same, without the temperature."""
        return -trial.require_log_density()
