"""Path measures: distance to the curve, progress along it, and the sway that no rail has."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves.curve import Curve
from mapctl.numerics import gaussian
from mapctl.numerics.gaussian import gaussian_kernel, low_pass

LOW_PASS_SECONDS = 0.5
"""Standard deviation of the Gaussian that takes natural sway out of the path error."""
SWAY_SECONDS = 0.35
"""Standard deviation of the Gaussian whose slow part is not sway."""


def compute_path_error(
    positions: Float[Tensor, "frames axes"], curve: Curve, arcs: Float[Tensor, "frames"]
) -> Float[Tensor, "frames"]:
    """Compute the distance of each position to the curve at the walk's arc, between the curve's ends, metres; without
    height for a ground curve. `arcs` come from `track`: the nearest point of all may belong to another branch."""
    on_it = arcs if curve.closed else arcs.clamp(0, curve.length)
    apart = curve.point(on_it) - (positions[:, ::2] if positions.shape[1] > curve.dims else positions)
    return apart.norm(dim=-1)


def compute_low_pass_error(
    positions: Float[Tensor, "frames axes"], curve: Curve, arcs: Float[Tensor, "frames"], fps: float
) -> Float[Tensor, "frames"]:
    """Compute the size of the sideways offset after a Gaussian of 0.5 s, metres.

    The offset is smoothed and not the walk, which would shrink on every bend. `arcs` come from `track`.
    """
    return low_pass(curve.signed_offset(positions, arcs), seconds=LOW_PASS_SECONDS, fps=fps).abs()


def sway(offset: Float[Tensor, "frames"], fps: float, seconds: float = SWAY_SECONDS) -> float:
    """Return the root mean square of a sideways offset without its slow part; NaN for clips too short (2.2 s)."""
    kernel = gaussian_kernel(seconds, fps)
    reach = len(kernel) // 2
    if len(offset) <= 2 * reach + 4:
        return math.nan
    # Inside, where the whole kernel lies on the walk.
    quick = (offset - gaussian.convolve(offset, kernel, "nothing"))[reach:-reach]
    return float(quick.square().mean().sqrt())


def straight_offset(ground: Float[Tensor, "frames 2"]) -> Float[Tensor, "frames"]:
    """Return the distance of a walk (x, z) from the line piece between its ends, metres; left is positive."""
    along = ground[-1] - ground[0]
    apart = ground - ground[0]
    share = ((apart @ along) / along.square().sum().clamp_min(1e-12)).clamp(0, 1)
    side = torch.sign(along[1] * apart[:, 0] - along[0] * apart[:, 1])
    return (apart - share[:, None] * along).norm(dim=-1) * side
