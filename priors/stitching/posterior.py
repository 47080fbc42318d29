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
_MOMENTS = 8  # at which a side is looked at, its ends among them
_LEAST_SIGMA = 0.3  # of what is shared: more than a nat and a quarter of each number is not told


class PosteriorNetwork(nn.Module):
    """Distributions of what both sides share, and of each frame's latent."""

    def __init__(self, config: StitcherConfig):
        super().__init__()
        self.frame = nn.Sequential(nn.Linear(LAYOUT.size, _WIDTH), nn.ELU(), nn.Linear(_WIDTH, _WIDTH), nn.ELU())
        self.whole = nn.Sequential(
            nn.Linear(SIDES * (_MOMENTS + 1) * _WIDTH, 2 * _WIDTH), nn.ELU(), nn.Linear(2 * _WIDTH, 2 * config.shared)
        )
        self.next = SidedLayers(SEEN_FUTURE * LAYOUT.size + config.encoder, 2 * _WIDTH, 2 * config.own)

    def tell_shared(self, missed: Float[Tensor, "2 batch made size"]) -> Gaussian:
        """Tell it from what the calm answer of both sides misses of the truth, in units of the features' spread.

        So it tells what the two ends do not. Over the batch each number's mean has unit variance, so that what is told
        cannot fade away (Zhu et al. 2020, "A batch normalized inference network keeps the KL vanishing away").
        """
        frames = self.frame(missed)
        at = torch.linspace(0, frames.shape[2] - 1, _MOMENTS).round().long()
        parts = torch.cat([frames.mean(dim=2, keepdim=True), frames[:, :, at]], dim=2)
        mean, raw = self.whole(parts.transpose(0, 1).flatten(1)).chunk(2, dim=-1)
        mean = (mean - mean.mean(dim=0)) / (mean.var(dim=0, correction=0) + 1e-5).sqrt()
        return Gaussian(mean, (_LEAST_SIGMA + (1 - _LEAST_SIGMA) * torch.sigmoid(raw)).log())

    def tell_own(
        self, ahead: Float[Tensor, "2 batch frames size"], encoded: Float[Tensor, "2 batch width"]
    ) -> Gaussian:
        """Tell a frame's from the true frames ahead, normalised, in each side's sense of time."""
        return Gaussian.of(self.next(torch.cat([ahead.flatten(-2), encoded], dim=-1)))
