"""Latents for a transition drawn from the prior, or at its mean."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from priors.stitching.network import Gaussian

_MEMORY = 0.7165  # exp(-1/3): what a frame's noise keeps of the frame before, so that it changes over three frames


@dataclass(frozen=True, eq=False)
class DrawnLatents:
    """Latents made of noise that was drawn before; with zeros the calm answer, at the mean."""

    shared: Float[Tensor, "batch shared"]
    """Standard normal."""
    slow: Float[Tensor, "2 batch made own"]
    """Of unit variance, slow over frames."""

    @staticmethod
    def calm(batch: int, made: int, shared: int, own: int) -> "DrawnLatents":
        """At the mean."""
        return DrawnLatents(torch.zeros(batch, shared), torch.zeros(2, batch, made, own))

    @staticmethod
    def sample(batch: int, made: int, shared: int, own: int, generator: torch.Generator) -> "DrawnLatents":
        """Drawn."""
        noise = torch.randn(batch, shared, generator=generator)
        return DrawnLatents(noise, draw_slow_noise(batch, made, own, generator))

    def still(self, rows: Bool[Tensor, " batch"]) -> "DrawnLatents":
        """Return the same with some rows at the mean."""
        drawn = (~rows).float()
        return DrawnLatents(self.shared * drawn[:, None], self.slow * drawn[:, None, None])

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


def draw_slow_noise(
    batch: int, frames: int, numbers: int, generator: torch.Generator
) -> Float[Tensor, "2 batch frames numbers"]:
    """Draw noise of unit variance for both sides whose correlation falls by e in three frames."""
    white = torch.randn(2, batch, frames, numbers, generator=generator)
    slow = [white[:, :, 0]]
    for frame in range(1, frames):
        slow.append(_MEMORY * slow[-1] + (1 - _MEMORY**2) ** 0.5 * white[:, :, frame])
    return torch.stack(slow, dim=2)
