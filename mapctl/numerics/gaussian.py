"""Gaussian smoothing along frames: every frame against every other for windows, a kernel for motions of any length."""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor


def pairwise_weights(
    count: int, sigma: float, dtype: torch.dtype, device: torch.device | None = None
) -> Float[Tensor, "count count"]:
    """Return Gaussian weights between all pairs of frames, 1 with itself; `sigma` is in frames."""
    frame = torch.arange(count, dtype=dtype, device=device)
    return torch.exp(-0.5 * ((frame[:, None] - frame) / sigma).square())


def averaging_matrix(
    count: int, sigma: float, dtype: torch.dtype, device: torch.device | None = None
) -> Float[Tensor, "count count"]:
    """Return a matrix whose row t averages frames around t, normalised over existing frames; `sigma` is in frames."""
    weight = pairwise_weights(count, sigma, dtype, device)
    return weight / weight.sum(dim=-1, keepdim=True)


def unit_variance_matrix(count: int, sigma: float, dtype: torch.dtype) -> Float[Tensor, "count count"]:
    """Return a matrix that smooths white noise to unit variance in every row; `sigma` is in frames."""
    weight = pairwise_weights(count, sigma, dtype)
    return weight / weight.square().sum(dim=-1, keepdim=True).sqrt()


def kernel(sigma: float, side: int) -> Float[Tensor, " taps"]:
    """Return 2 * side + 1 weights that sum to one, the middle one the greatest; `sigma` is in frames."""
    weight = torch.exp(-0.5 * (torch.arange(-side, side + 1, dtype=torch.float64) / sigma).square())
    return weight / weight.sum()


def convolve(
    values: Float[Tensor, "frames *width"], taps: Float[Tensor, " taps"], ends: Literal["nothing", "repeated"]
) -> Float[Tensor, "frames *width"]:
    """Average the frames around each frame by a kernel's `taps`, odd in number; beyond the ends there is nothing, or
    the outermost frame repeated."""
    side = len(taps) // 2
    channels = values.flatten(1).T[:, None] if values.ndim > 1 else values[None, None]
    if ends == "repeated":
        channels, side = torch.nn.functional.pad(channels, (side, side), mode="replicate"), 0
    out = torch.nn.functional.conv1d(channels, taps.to(values)[None, None], padding=side)[:, 0].T
    return out.reshape(values.shape)


def gaussian_kernel(seconds: float, fps: float) -> Float[Tensor, "taps"]:
    """Return kernel weights that sum to one; `seconds` is the standard deviation."""
    return kernel(seconds * fps, int(3 * seconds * fps))


def low_pass(values: Float[Tensor, "frames"], *, seconds: float, fps: float) -> Float[Tensor, "frames"]:
    """Smooth a signal, every frame of it: near the ends the weights are those of the frames there are."""
    kernel = gaussian_kernel(seconds, fps)
    both = torch.stack([values, torch.ones_like(values)], dim=-1)
    summed, weight = convolve(both, kernel, "nothing").unbind(dim=-1)
    return summed / weight


def smooth(values: Float[Tensor, "frames *width"], sigma: float) -> Float[Tensor, "frames *width"]:
    """Smooth values by a kernel of `sigma` frames; ends are held."""
    return convolve(values, kernel(max(sigma, 1e-6), side=max(1, round(3 * sigma))), "repeated")


def envelope(values: Float[Tensor, "frames columns"], seconds: float, fps: float) -> Float[Tensor, "frames columns"]:
    """Return smooth values that are about as high as the highest within so many seconds before and after."""
    frames = max(1, round(seconds * fps))
    padded = torch.nn.functional.pad(values.T[None], (frames, frames), mode="replicate")
    return smooth(torch.nn.functional.max_pool1d(padded, 2 * frames + 1, stride=1)[0].T, frames / 2)
