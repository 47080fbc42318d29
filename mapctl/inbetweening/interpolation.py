"""Interpolation of a motion where it is not known: rotations along the shortest arc, root and heading linearly."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.numerics.intervals import fill_missing, fill_missing_angle, last_observed, next_observed
from mapctl.skeleton import CANONICAL


def interpolate_positions(
    positions_world: Float[Tensor, "batch frames joints 3"],
    local_quat_xyzw: Float[Tensor, "batch frames joints 4"],
    known: Bool[Tensor, "batch frames joints"],
) -> Float[Tensor, "batch frames joints 3"]:
    """Interpolate world positions, metres, on canonical bones; known ones as they are. Unknown values may be anything
    finite.

    A rotation is known while the joint and its children are.
    """
    shown = known.clone()
    for joint, parent in enumerate(CANONICAL.parents):
        if parent >= 0:
            shown[..., parent] &= known[..., joint]
    batch, _, joints = shown.shape
    columns = shown.transpose(1, 2).flatten(0, 1)
    before, after = last_observed(columns), next_observed(columns)
    weight = (torch.arange(columns.shape[1]) - before).to(positions_world) / (after - before).clamp_min(1)
    quats = local_quat_xyzw.transpose(1, 2).flatten(0, 1)
    missing = ~columns
    row, frame = missing.nonzero(as_tuple=True)
    between = rotations.slerp(quats[row, before[missing]], quats[row, after[missing]], weight[row, frame].clamp(0, 1))
    quats = quats.index_put((row, frame), between)
    matrices = rotations.to_matrix(quats.unflatten(0, (batch, joints)).transpose(1, 2))
    root = fill_missing(positions_world[:, :, 0], known[..., 0])
    interpolated = kinematics.positions_from_matrices(CANONICAL, matrices) + root[:, :, None]
    return torch.where(known[..., None], positions_world, interpolated)


def interpolate_heading(heading: Float[Tensor, "batch frames"], known: Bool[Tensor, "batch frames joints"]) -> Tensor:
    """Interpolate headings, radians, linearly along the shorter arc between frames whose root is known."""
    return fill_missing_angle(heading, known[..., 0])
