"""Begin a wider or deeper pose transformer with what a smaller one has learnt (Net2Net, Chen et al. 2016)."""

from collections.abc import Mapping

import torch
from torch import Tensor

from priors.pose_transformer.network import PoseTransformerConfig, PoseTransformerNetwork

_WRITES = (".bones.", ".embed.2.", ".near.", ".join.", ".perceptron.2.", ".head.", ".spread.2.")
"""Weights whose new part is nothing at first, so that what they put out stays what it was."""
_NORMS = (".first.", ".second.", ".norm.")


def can_grow(small: PoseTransformerConfig, large: PoseTransformerConfig) -> bool:
    """Whether the heads are equally wide, the convolutions equally long, and nothing is smaller."""
    alike = small.kernel == large.kernel and small.width * large.heads == large.width * small.heads
    alike = alike and small.detail == large.detail
    return alike and small.width <= large.width and small.layers <= large.layers


def grow(
    weights: Mapping[str, Tensor], small: PoseTransformerConfig, network: PoseTransformerNetwork
) -> dict[str, Tensor]:
    """Return weights for `network` that answer nearly as those of the smaller one do (see `can_grow`).

    New numbers of a token are zero at first and new layers add nothing; what reads them keeps the network's own random
    weights, so they are learnt from the first step. Norms are scaled for the zeros: were the mean over a token zero,
    the answer would be the same.
    """
    large = network.config
    grown = {}
    for name, fresh in network.state_dict().items():
        old = weights.get(name)
        writes = any(part in f".{name}" for part in _WRITES)
        start = torch.zeros_like(fresh) if writes else fresh.clone()
        if old is not None:
            start[_find_place(name, old, small, large)] = old.to(fresh)
        if any(part in f".{name}" for part in _NORMS) and name.endswith("weight"):
            # The new zeros make the variance over a token smaller.
            start *= (small.width / large.width) ** 0.5 if old is not None else 1.0
        grown[name] = start
    return grown


def _find_place(name: str, old: Tensor, small: PoseTransformerConfig, large: PoseTransformerConfig) -> tuple:
    """Find where in the larger tensor the smaller one belongs: at the beginning of each axis, head by head."""
    place = tuple(slice(size) for size in old.shape)
    if ".split." not in name:
        return place
    rows = torch.arange(3 * large.width).unflatten(0, (3, large.heads, -1))[:, : small.heads].flatten()
    return (rows, *place[1:])
