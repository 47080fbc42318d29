"""Shares of the evidence with intervals over clips, so that what is named can be told from chance."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import torch
from jaxtyping import Float, Int
from torch import Tensor

_LEVEL = 0.95
_RESAMPLES = 400


@dataclass(frozen=True)
class Share:
    """What one group of inputs weighs in the verdict."""

    name: str
    """Group: a joint, a band, a kind of input, a moment."""
    share: float
    """Share of the evidence, 0 to 1 where nothing speaks against it; shares of a table add up to 1."""
    low: float
    """Lower end of its interval, of 95 % for all groups of the table together."""
    high: float
    """Upper end of its interval."""
    exchanged: float | None = None
    """Balanced held-out accuracy where made and mocap windows exchange this group with their nearest of the other set;
    None where that is not measured."""
    alone: float | None = None
    """Balanced held-out accuracy of a network that is given nothing but this group; None where that is not measured."""
    frames: float | None = None
    """Share of all frames that are of this kind; None unless it is a kind of moment."""

    @property
    def named(self) -> bool:
        """Whether this is more than chance: the interval lies above 0, for a kind of moment above its frames' part."""
        return self.low > (self.frames or 0.0)

    @property
    def times(self) -> float:
        """Evidence beside that of an equal share of frames; the share itself where frames are not counted."""
        return self.share if not self.frames else self.share / self.frames


@dataclass(frozen=True, eq=False)
class Side:
    """Evidence of one set's windows by group, summed over each clip."""

    sums: Float[Tensor, "clips groups"]
    """Sum over the clip's windows."""
    counts: Float[Tensor, " clips"]
    """Number of the clip's windows."""

    @staticmethod
    def of(evidence: Float[Tensor, "windows groups"], clip: Int[Tensor, " windows"]) -> "Side":
        """Sum windows by clip."""
        clips, number = clip.unique(return_inverse=True)
        sums = torch.zeros(len(clips), evidence.shape[1], dtype=torch.float64)
        return Side(sums.index_add_(0, number, evidence.double()), torch.bincount(number).double())

    def average(self, weights: Float[Tensor, "draws clips"]) -> Float[Tensor, "draws groups"]:
        """Average over windows, clips weighed by how often each was drawn."""
        return weights @ self.sums / (weights @ self.counts).clamp_min(1)[:, None]

    def draw(self, generator: torch.Generator) -> Float[Tensor, "draws clips"]:
        """Draw clips with replacement, many times, and count how often each came: a bootstrap (Efron 1979)."""
        clips = len(self.counts)
        drawn = torch.randint(clips, (_RESAMPLES, clips), generator=generator)
        return torch.zeros(_RESAMPLES, clips, dtype=torch.float64).scatter_add_(
            1, drawn, torch.ones_like(drawn).double()
        )


def compute_shares(
    names: Sequence[str],
    sides: Sequence[Side],
    generator: torch.Generator,
    *,
    exchanged: Sequence[float] | None = None,
    frames: Sequence[float] | None = None,
) -> list[Share]:
    """Compute shares of the evidence, the mean of both sides, largest first (by `Share.times`).

    Intervals are normal, with the deviation of shares when clips are drawn anew (networks are not trained anew), and
    widened for the number of groups (Bonferroni), so that of a table without any cause one in twenty names one.
    """
    whole = _divide(torch.stack([side.average(torch.ones(1, len(side.counts)).double()) for side in sides]).mean(0))[0]
    drawn = _divide(torch.stack([side.average(side.draw(generator)) for side in sides]).mean(0))
    reach = NormalDist().inv_cdf(1 - (1 - _LEVEL) / (2 * len(names))) * drawn.std(dim=0)
    shares = [
        Share(
            name,
            float(whole[k]),
            float(whole[k] - reach[k]),
            float(whole[k] + reach[k]),
            exchanged=None if exchanged is None else exchanged[k],
            frames=None if frames is None else frames[k],
        )
        for k, name in enumerate(names)
    ]
    return sorted(shares, key=lambda one: one.times, reverse=True)


def _divide(means: Float[Tensor, "draws groups"]) -> Float[Tensor, "draws groups"]:
    return means / means.sum(dim=1, keepdim=True)
