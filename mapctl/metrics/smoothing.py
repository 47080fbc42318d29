"""Gaussian smoothing over time, cut at three standard deviations; parts the slow from the quick."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.numerics import gaussian


def gaussian_kernel(seconds: float, fps: float) -> Float[Tensor, "taps"]:
    """Weights that sum to one; `seconds` is the standard deviation."""
    return gaussian.kernel(seconds * fps, int(3 * seconds * fps))


def slow_part(values: Float[Tensor, "frames"], *, seconds: float, fps: float) -> Float[Tensor, "frames"]:
    """The smoothed signal, every frame of it: near the ends the weights are those of the frames there are."""
    kernel = gaussian_kernel(seconds, fps)
    both = torch.stack([values, torch.ones_like(values)], dim=-1)
    summed, weight = gaussian.convolved(both, kernel, "nothing").unbind(dim=-1)
    return summed / weight
