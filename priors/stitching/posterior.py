"""The posterior of a transition's latent, which sees the truth: in training alone, and in no file of weights.

Ren et al. 2024 have none: their encoder (section 3.3) sees the ends, and nothing of what comes between.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.features import LAYOUT
from priors.stitching.layers import SIDES, SidedLayers
from priors.stitching.network import SEEN_FUTURE, Gaussian, StitcherConfig

_WIDTH = 128
_MOMENTS = 4  # quarters of the way at which the whole is looked at
_LEAST_SIGMA = 0.3  # of what is shared: more than a nat and a half of each number is not told


class PosteriorNetwork(nn.Module):
    """Distributions of what both sides share, and of each frame's latent."""

    def __init__(self, config: StitcherConfig):
        super().__init__()
        self.frame = nn.Sequential(nn.Linear(LAYOUT.size, _WIDTH), nn.ELU(), nn.Linear(_WIDTH, _WIDTH), nn.ELU())
        self.whole = nn.Sequential(
            nn.Linear((_MOMENTS + 1) * _WIDTH, 2 * _WIDTH), nn.ELU(), nn.Linear(2 * _WIDTH, 2 * config.shared)
        )
        self.expect = nn.Sequential(
            nn.Linear(SIDES * 3 * config.embedding[-1], 2 * _WIDTH), nn.ELU(), nn.Linear(2 * _WIDTH, config.shared)
        )
        self.next = SidedLayers(SEEN_FUTURE * LAYOUT.size + config.encoder, 2 * _WIDTH, 2 * config.own)

    def tell_shared(
        self, truth: Float[Tensor, "batch frames size"], seen: Float[Tensor, "2 batch seen"]
    ) -> tuple[Gaussian, Float[Tensor, "batch shared"]]:
        """Tell it from the whole way from pose to pose, normalised features forwards; also return the errors of what
        the ends alone let expect, which are to become small.

        What is told is what the ends do not tell: the rest of it has been taken off. Over the batch each number's mean
        has unit variance, so that what is told cannot fade away (Zhu et al. 2020, "A batch normalized inference network
        keeps the KL vanishing away").
        """
        frames = self.frame(truth)
        at = torch.linspace(0, frames.shape[1] - 1, _MOMENTS).round().long()
        told, raw = self.whole(torch.cat([frames.mean(dim=1), frames[:, at].flatten(1)], dim=-1)).chunk(2, dim=-1)
        told = _standardise(told)
        expected = self.expect(seen.detach().transpose(0, 1).flatten(1))
        mean = _standardise(told - expected.detach())
        sigma = _LEAST_SIGMA + (1 - _LEAST_SIGMA) * torch.sigmoid(raw)
        return Gaussian(mean, sigma.log()), expected - told.detach()

    def tell_own(
        self, ahead: Float[Tensor, "2 batch frames size"], encoded: Float[Tensor, "2 batch width"]
    ) -> Gaussian:
        """Tell a frame's from the true frames ahead, normalised, in each side's sense of time."""
        return Gaussian.of(self.next(torch.cat([ahead.flatten(-2), encoded], dim=-1)))


def _standardise(values: Float[Tensor, "batch shared"]) -> Float[Tensor, "batch shared"]:
    """Shift and scale each number to zero mean and unit variance over the batch."""
    return (values - values.mean(dim=0)) / (values.var(dim=0, correction=0) + 1e-5).sqrt()
