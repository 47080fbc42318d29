"""How long people take from one pose to the next: a regression over mocap, by which a timing is suggested.

The logarithm of the seconds is linear in what two poses show (see mapctl.inbetweening.pose_pairs).
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl.inbetweening.pose_pairs import MAX_FITTED_DISTANCE, PAIR_FEATURES, TRAVELLING_DISTANCE
from priors import checkpoints
from priors.checkpoints import NetworkConfig

SHORTEST, LONGEST = 0.25, 4.0
"""Seconds that are suggested at least, and at most where a pair is no farther apart than the fit's; poses of these are
as far apart in time."""


@dataclass(frozen=True)
class KeyframeTimingConfig(NetworkConfig):
    """Shape of the regression, which leaves no choice."""

    FIXED: ClassVar = {"features": list(PAIR_FEATURES), "shortest": SHORTEST, "longest": LONGEST}


class KeyframeTimingNetwork(nn.Module):
    """Weights of the regression, and how far off it is."""

    weights: Float[Tensor, " features"]
    ratios: Float[Tensor, "2 2"]

    def __init__(self, config: KeyframeTimingConfig):
        """Unfitted, it predicts one second for every pair."""
        super().__init__()
        self.config = config
        self.register_buffer("weights", torch.zeros(len(PAIR_FEATURES)))
        # 10th and 90th percentile of true over suggested seconds, of pairs about in place and of pairs that travel.
        self.register_buffer("ratios", torch.ones(2, 2))

    def forward(
        self, features: Float[Tensor, "pairs features"], metres: Float[Tensor, " pairs"]
    ) -> Float[Tensor, "pairs 3"]:
        """Seconds that four of five pairs take at least, that are suggested, and that they take at most."""
        seconds = torch.exp(features @ self.weights.to(features)).clamp(SHORTEST, LONGEST)
        seconds = seconds * (metres / MAX_FITTED_DISTANCE).clamp_min(1)
        low, high = self.ratios.to(features)[(metres >= TRAVELLING_DISTANCE).long()].unbind(dim=-1)
        return torch.stack([low * seconds, seconds, high * seconds], dim=-1)


@dataclass(frozen=True, eq=False, repr=False)
class KeyframeTiming(checkpoints.NetworkModel[KeyframeTimingNetwork]):
    """A fitted regression, as controllers get it."""

    kind, parts = "keyframe-timing", (KeyframeTimingNetwork, KeyframeTimingConfig)

    def estimate_seconds(
        self, features: Float[Tensor, "pairs features"], metres: Float[Tensor, " pairs"]
    ) -> Float[Tensor, "pairs 3"]:
        """Estimate the seconds that four of five pairs of keys take at least, that are suggested, and that they take at
        most, by features of the pairs and how far apart they are, metres."""
        return self.network(features, metres)
