"""Gaussian smoothing along frames: every frame against every other for windows, a kernel for motions of any length."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor


def pairwise_weights(
    count: int, sigma: float, dtype: torch.dtype, device: torch.device | None = None
) -> Float[Tensor, "count count"]:
    """How much each frame has to do with each other: 1 with itself; `sigma` is in frames. Memory is count squared."""
    frame = torch.arange(count, dtype=dtype, device=device)
    return torch.exp(-0.5 * ((frame[:, None] - frame) / sigma).square())


def averaging_matrix(
    count: int, sigma: float, dtype: torch.dtype, device: torch.device | None = None
) -> Float[Tensor, "count count"]:
    """Row t averages the frames around t, normalised over the frames there are; `sigma` is in frames."""
    weight = pairwise_weights(count, sigma, dtype, device)
    return weight / weight.sum(dim=-1, keepdim=True)


def kernel(sigma: float, side: int) -> Float[Tensor, " taps"]:
    """2 * side + 1 weights that add up to one, the middle one the greatest; `sigma` is in frames."""
    weight = torch.exp(-0.5 * (torch.arange(-side, side + 1, dtype=torch.float64) / sigma).square())
    return weight / weight.sum()


def convolve(
    values: Float[Tensor, "frames *width"], taps: Float[Tensor, " taps"], ends: Literal["nothing", "repeated"]
) -> Float[Tensor, "frames *width"]:
    """Each frame as the mean of those around it that a kernel's `taps`, odd in number, say; beyond the ends there is
    nothing, or the outermost frame again and again.
    """
    side = len(taps) // 2
    channels = values.flatten(1).T[:, None] if values.ndim > 1 else values[None, None]
    if ends == "repeated":
        channels, side = torch.nn.functional.pad(channels, (side, side), mode="replicate"), 0
    out = torch.nn.functional.conv1d(channels, taps.to(values)[None, None], padding=side)[:, 0].T
    return out.reshape(values.shape)


def gaussian_kernel(seconds: float, fps: float) -> Float[Tensor, "taps"]:
    """Weights that sum to one; `seconds` is the standard deviation."""
    return kernel(seconds * fps, int(3 * seconds * fps))


def low_pass(values: Float[Tensor, "frames"], *, seconds: float, fps: float) -> Float[Tensor, "frames"]:
    """The smoothed signal, every frame of it: near the ends the weights are those of the frames there are."""
    kernel = gaussian_kernel(seconds, fps)
    both = torch.stack([values, torch.ones_like(values)], dim=-1)
    summed, weight = convolve(both, kernel, "nothing").unbind(dim=-1)
    return summed / weight
