"""Gaussian smoothing along frames: every frame against every other for windows, a kernel for motions of any length."""

from typing import Literal

import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
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


def smooth(
    values: Float[Tensor, "frames *width"],
    sigma: float,
    *,
    side: int | None = None,
    ends: Literal["nearest", "constant"] = "nearest",
) -> Float[Tensor, "frames *width"]:
    """Average the frames around each frame, `sigma` in frames; so many on either `side` count, or those within three
    sigmas. Beyond the ends is the frame that is nearest, or nothing (`constant`)."""
    radius = max(1, round(3 * sigma)) if side is None else side
    found = gaussian_filter1d(values.cpu().numpy(), max(sigma, 1e-6), axis=0, mode=ends, radius=radius)
    return torch.from_numpy(found).to(values)


def average(values: Float[Tensor, "frames *width"], *, seconds: float, fps: float) -> Float[Tensor, "frames *width"]:
    """Average a signal around each frame; near the ends over the frames there are."""
    summed, weight = (
        smooth(each, seconds * fps, side=int(3 * seconds * fps), ends="constant")
        for each in (values, torch.ones_like(values))
    )
    return summed / weight


def envelope(values: Float[Tensor, "frames columns"], seconds: float, fps: float) -> Float[Tensor, "frames columns"]:
    """Return smooth values that are about as high as the highest within so many seconds before and after."""
    frames = max(1, round(seconds * fps))
    padded = torch.nn.functional.pad(values.T[None], (frames, frames), mode="replicate")
    return smooth(torch.nn.functional.max_pool1d(padded, 2 * frames + 1, stride=1)[0].T, frames / 2)
