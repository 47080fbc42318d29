"""Motion in the residual that a proposal leaves of a capture, beyond what noise explains, and its restoration.

The residual between a capture and a model's proposal should be noise of known power and correlation. Where the model is
out of its depth the residual holds motion too, slower than the noise. How much smoothing brings that back is estimated,
moment by moment and joint by joint, by Stein's unbiased estimate of the risk (see mapctl.recording.sure_smoothing):
none, where the model is right; a plain low-pass filter of the capture itself, where the model knows nothing.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.numerics import gaussian

_WIDTHS = (0.6, 0.8, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6)  # frames, sigma of the smoothing
_RISK_FRAMES = 20.0  # frames, sigma, over which the risk is estimated
_PENALTY = 0.1  # of the noise's power, that a return must gain: the risk itself is estimated with an error
_CAUTION = 0.5  # and this share of the noise that it would bring back
_TEMPERATURE = 0.06  # of the noise's power, between choices that are as good as equal
WHITE = torch.ones(1, dtype=torch.float64)
"""Correlation of white noise with itself so many frames later, from 0 on."""


def restore_residual_motion(
    rest: Float[Tensor, "frames joints 3"],
    seen: Bool[Tensor, "frames joints"],
    sigma: Float[Tensor, " joints"],
    correlation: Float[Tensor, " lags"] = WHITE,
) -> tuple[Float[Tensor, "frames joints 3"], Float[Tensor, "frames joints"]]:
    """Return what of the residual goes back, and the share of smoothing by frame and joint: 0 where the model is
    trusted, 1 where it is not. `sigma` is the noise of each of the three numbers; where it is 0 nothing goes back.
    `correlation` is that of the noise with itself so many frames later, from 0 on; beyond its end it is 0."""
    known = seen.to(rest)[..., None]
    rest = rest * known
    noise = 3 * sigma.square().clamp_min(1e-12)
    trusted = _local_mean(rest.square().sum(-1, keepdim=True), known)[..., 0] / noise - 1
    risks, smooth = [trusted], [torch.zeros_like(rest)]
    for width in _WIDTHS:
        kernel = gaussian.kernel(width, max(1, round(3 * width)))
        weight = gaussian.convolve(known, kernel, "nothing")
        wide = gaussian.convolve(rest, kernel, "nothing") / weight.clamp_min(1e-6)
        change = ((wide - rest) * known).square().sum(-1, keepdim=True)
        own = _weigh_own(kernel, correlation) / weight[..., 0].clamp_min(0.1)
        risks.append(_local_mean(change, known)[..., 0] / noise + (2 + _CAUTION) * own - 1 + _PENALTY)
        smooth.append(wide)
    share = torch.softmax(-torch.stack(risks) / _TEMPERATURE, dim=0)
    back = (share[..., None] * torch.stack(smooth)).sum(dim=0)
    noisy = (sigma > 0).to(rest)
    return back * noisy[None, :, None], (1 - share[0]) * noisy


def _weigh_own(kernel: Float[Tensor, " taps"], correlation: Float[Tensor, " lags"]) -> Tensor:
    """How much of a frame's noise a kernel's average of the frames around it holds: tr(S C) / frames in Stein's
    estimate for noise of covariance C."""
    side = len(kernel) // 2
    lags = torch.arange(-side, side + 1).abs()
    return (kernel * torch.nn.functional.pad(correlation, (0, side + 1))[lags]).sum()


def _local_mean(values: Float[Tensor, "frames joints 1"], known: Float[Tensor, "frames joints 1"]) -> Tensor:
    """Average what is known over `_RISK_FRAMES`."""
    kernel = gaussian.kernel(_RISK_FRAMES, round(2 * _RISK_FRAMES))
    weight = gaussian.convolve(known, kernel, "nothing")
    return gaussian.convolve(values * known, kernel, "nothing") / weight.clamp_min(1e-6)
