"""Latents for a transition drawn from the prior, or at its mean."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from priors.stitching.network import Gaussian, StitcherConfig

_MEMORY = 0.7165  # exp(-1/3): what a frame's noise keeps of the frame before, so that it changes over three frames


@dataclass(frozen=True, eq=False)
class DrawnLatents:
    """Latents made of noise that was drawn before; with zeros the calm answer, at the mean."""

    shared: Float[Tensor, "batch shared"]
    """Standard normal."""
    slow: Float[Tensor, "2 batch made own"]
    """Of unit variance, slow over frames."""

    @staticmethod
    def calm(config: StitcherConfig, batch: int, made: int) -> "DrawnLatents":
        """At the mean."""
        return DrawnLatents(torch.zeros(batch, config.shared), torch.zeros(2, batch, made, config.own))

    @staticmethod
    def sample(config: StitcherConfig, batch: int, made: int, generator: torch.Generator) -> "DrawnLatents":
        """Drawn."""
        noise = torch.randn(batch, config.shared, generator=generator)
        memory = 0.0 if config.printed else _MEMORY
        return DrawnLatents(noise, _draw_noise(batch, made, config.own, memory, generator))

    def still(self, rows: Bool[Tensor, " batch"]) -> "DrawnLatents":
        """Return the same with some rows at the mean."""
        drawn = (~rows).float()
        return DrawnLatents(self.shared * drawn[:, None], self.slow * drawn[:, None, None])

    def scale(self, temperature: float) -> "DrawnLatents":
        """Return the same with noise of another standard deviation."""
        return DrawnLatents(temperature * self.shared, temperature * self.slow)

    def rows(self, index: Int[Tensor, " rows"]) -> "DrawnLatents":
        """Return some rows."""
        return DrawnLatents(self.shared[index], self.slow[:, index])

    def put(self, index: Int[Tensor, " rows"], other: "DrawnLatents") -> "DrawnLatents":
        """Return the same with other latents in some rows."""
        return DrawnLatents(self.shared.index_copy(0, index, other.shared), self.slow.index_copy(1, index, other.slow))

    def share(self, prior: Gaussian, seen: Float[Tensor, "2 batch seen"]) -> Float[Tensor, "batch shared"]:
        """What both sides share over the transition."""
        return prior.draw(self.shared)

    def own(self, prior: Gaussian, encoded: Float[Tensor, "2 batch width"], step: int) -> Float[Tensor, "2 batch own"]:
        """A frame's, of both sides."""
        return prior.draw(self.slow[:, :, step])


def _draw_noise(
    batch: int, frames: int, numbers: int, memory: float, generator: torch.Generator
) -> Float[Tensor, "2 batch frames numbers"]:
    """Draw noise of unit variance for both sides of which a frame keeps a share of the frame before."""
    white = torch.randn(2, batch, frames, numbers, generator=generator)
    slow = [white[:, :, 0]]
    for frame in range(1, frames):
        slow.append(memory * slow[-1] + (1 - memory**2) ** 0.5 * white[:, :, frame])
    return torch.stack(slow, dim=2)
