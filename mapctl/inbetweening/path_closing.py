"""A predicted trajectory of the hips, led through the positions that are known.

What the prediction misses the next known position by is spread in proportion to the way walked: who stands does not
slide, and who walks takes steps that are a little longer, shorter or aside.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.inbetweening.loose_keys import LooseKeys
from mapctl.numerics.intervals import true_intervals

_LEAST_STEP = 1e-4  # metres a frame that even a body which does not move counts as walking


def close_path(
    predicted: Float[Tensor, "frames 3"], known: Float[Tensor, "frames 3"], lost: Bool[Tensor, " frames"]
) -> Float[Tensor, "frames 3"]:
    """Return the known positions (metres, Y up), and where they are lost the predicted steps from the last known one,
    led to the next; before the first known one they are followed backwards. Without any known one the prediction
    stays as it is.

    Heights are predicted by themselves and not by steps: what they are off by at a known frame fades linearly to what
    they are off by at the next.
    """
    path = known.clone()
    steps = torch.diff(predicted[:, ::2], dim=0, prepend=predicted[:1, ::2])
    walked = torch.cumsum(steps.norm(dim=-1) + _LEAST_STEP, dim=0)
    frame = torch.arange(len(predicted)).to(predicted)
    for _, start, stop in true_intervals(lost[:, None]):
        edges = [edge for edge in (start - 1, stop) if 0 <= edge < len(predicted)]
        if not edges:
            return predicted
        miss = (known - predicted)[edges]
        for axes, clock in (((0, 2), walked), ((1,), frame)):
            first, last = clock[edges[0]], clock[edges[-1]]
            share = ((clock[start:stop] - first) / (last - first).clamp_min(1e-12)).clamp(0, 1)
            offset = torch.lerp(miss[0, list(axes)], miss[-1, list(axes)], share[:, None])
            path[start:stop, list(axes)] = predicted[start:stop, list(axes)] + offset
    return path


def lead_over_keys(
    predicted: Float[Tensor, "frames 3"],
    known: Float[Tensor, "frames 3"],
    lost: Bool[Tensor, " frames"],
    loose: LooseKeys | None,
) -> Float[Tensor, "frames 3"]:
    """Close a path as `close_path` does, over places of loose keys too, which tell no height."""
    path = close_path(predicted, known, lost)
    if loose is None or not bool(loose.placed.any()):
        return path
    told = torch.stack([loose.ground[:, 0], predicted[:, 1], loose.ground[:, 1]], dim=-1).to(known)
    placed = lost & loose.placed
    ground = close_path(predicted, torch.where(placed[:, None], told, known), lost & ~placed)
    return torch.stack([ground[:, 0], path[:, 1], ground[:, 2]], dim=-1)
