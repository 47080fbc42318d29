"""Gaussian smoothing over time, cut at three standard deviations; parts the slow from the quick."""

import torch
from jaxtyping import Float
from torch import Tensor


def gaussian_kernel(seconds: float, fps: float) -> Float[Tensor, "taps"]:
    """Weights that sum to one; `seconds` is the standard deviation."""
    taps = int(3 * seconds * fps)
    at = torch.arange(-taps, taps + 1, dtype=torch.float64) / fps
    kernel = torch.exp(-0.5 * (at / seconds).square())
    return kernel / kernel.sum()


def slow_part_inside(values: Float[Tensor, "frames"], kernel: Float[Tensor, "taps"]) -> Float[Tensor, "inside"]:
    """The smoothed signal where the whole kernel lies inside it: `taps` - 1 frames fewer."""
    return torch.nn.functional.conv1d(values[None, None], kernel[None, None])[0, 0]


def slow_part(values: Float[Tensor, "frames"], *, seconds: float, fps: float) -> Float[Tensor, "frames"]:
    """The smoothed signal, every frame of it: near the ends the weights are those of the frames there are."""
    kernel = gaussian_kernel(seconds, fps)
    both = torch.stack([values, torch.ones_like(values)])[:, None]
    summed, weight = torch.nn.functional.conv1d(both, kernel[None, None], padding=len(kernel) // 2)[:, 0]
    return summed / weight
