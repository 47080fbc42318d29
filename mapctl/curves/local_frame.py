"""Local frames of curves: the nearest position to each walker and the curve's axes there, in one compiled pass.

Same positions and directions as `Curve.nearest`, `Curve.point`, `Curve.tangent` and `Curve.left`, which are the
specification; a term that asks for all of them at every evaluation asks here.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.curves import Curve, local_frame_kernels


@dataclass(frozen=True, eq=False)
class LocalFrame:
    """The curve near each point; constants, without gradient."""

    place: Float[Tensor, "batch frames dims"]
    """Nearest position on the curve, metres."""
    axes: Float[Tensor, "batch frames dims dims"]
    """Unit rows: left on the ground, forward; in space a third, upward less what of it lies along the slope."""
    tangent_extension: Float[Tensor, "batch frames dims"]
    """Position of the arc looked around if the curve went straight on from the nearest one, metres."""


class _CurveTables(NamedTuple):
    knots: np.ndarray
    corners: np.ndarray
    directions: np.ndarray
    closed: bool
    length: float
    half_base: float


def find_local_frames(
    curve: Curve, points: Float[Tensor, "batch frames dims"], around: Float[Tensor, " frames"], *, reach: float
) -> LocalFrame:
    """Find the nearest positions within `reach` metres of the arcs `around`; results have the points' dtype.

    Points have the curve's dimensions. Arcs that are not finite give NaN.
    """
    arcs = around.detach().double().contiguous().numpy()
    known = points.detach().contiguous()
    near = LocalFrame(torch.empty_like(known), known.new_empty(*known.shape, curve.dims), torch.empty_like(known))
    filled = (near.place.numpy(), near.axes.numpy(), near.tangent_extension.numpy())
    local_frame_kernels.fill_local_frames(_build_tables(curve), known.numpy(), arcs, reach, *filled)
    return near


def _build_tables(curve: Curve) -> _CurveTables:
    knots, corners, directions = (table.numpy() for table in curve._tables)
    return _CurveTables(knots, corners, directions, curve.closed, curve.length, curve._half_base)
