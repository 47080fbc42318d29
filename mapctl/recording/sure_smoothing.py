"""Smoothing as wide as the noise asks for: Gaussian, its width by Stein's unbiased estimate of the risk (Stein 1981).

The squared error of a linear smoother is, but for a constant, its squared change of the data plus twice the noise's
variance times its trace.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.numerics import gaussian

_WIDTHS = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 12.0, 16.0, 24.0, 32.0)  # frames, sigma
_KERNEL_SIGMAS = 3.0  # sigmas that a kernel has on either side


def smooth_rotations(
    quats: Float[Tensor, "frames joints 4"], sigma: Float[Tensor, " joints"]
) -> Float[Tensor, "frames joints 4"]:
    """Smooth each joint's rotations over time; `sigma` is the noise of each angle, radians. Without noise nothing is
    changed."""
    quats = rotations.make_sign_continuous(quats)
    best = quats.clone()
    # A quaternion's components have half of the angle's noise.
    noise = 0.25 * 3 * sigma.square()
    risk = torch.zeros_like(sigma)
    for width in _WIDTHS[1:]:
        if _KERNEL_SIGMAS * width >= len(quats):
            break
        kernel = gaussian.kernel(width, max(1, round(_KERNEL_SIGMAS * width)))
        wide = gaussian.convolve(quats, kernel, "repeated")
        change = (wide - quats).square().sum(dim=-1).mean(dim=0)
        wide_risk = change + 2 * noise * kernel.max() - 2 * noise
        better = (wide_risk < risk) & (sigma > 0)
        best = torch.where(better[None, :, None], wide, best)
        risk = torch.where(better, wide_risk, risk)
    return torch.nn.functional.normalize(best, dim=-1)
