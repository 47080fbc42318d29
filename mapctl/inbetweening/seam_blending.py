"""Closing the seams of a gap: what was put into it is moved, by as little as possible and smoothly, until the motion
runs on across both of its edges without a leap or a kink.

The offset o of a gap's frames solves  min |D o + e|^2 + eps |o|^2,  D the second differences, e those of the motion as
it is where they reach across an edge, as far as they are more than the motion's usual, and 0 within: leaps and kinks at
the edges go, what is within keeps its shape, and a seam without any is left alone.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.numerics import smooth_offsets
from mapctl.numerics.intervals import true_intervals

_SEAM_FADE_SECONDS = 0.1  # seconds over which an offset fades away from its edge
_USUAL_QUANTILE = 0.8
_CALM_ACCELERATION, _CALM_ANGULAR_ACCELERATION = 1.2, 9.0  # m/s^2 and rad/s^2 that are nothing unusual in any motion


def blend_seams_in_positions(
    values: Float[Tensor, "frames width"], put: Bool[Tensor, " frames"], *, fps: float
) -> Float[Tensor, "frames width"]:
    """Places whose frames `put` were put in; all others stay."""
    values = values.clone()
    usual = _estimate_usual_size(torch.diff(values, n=2, dim=0)[:, None], put[:, None], _CALM_ACCELERATION / fps**2)
    for _, start, stop in true_intervals(put[:, None]):
        rows = smooth_offsets.find_overlapping_differences(start, stop, len(values))
        bends = torch.diff(values[rows.start : rows.stop + 2], n=2, dim=0)[:, None] if len(rows) else values[:0, None]
        beyond = _compute_excess_at_edges(bends, usual, start, stop, len(values))
        values[start:stop] += _solve_offset(beyond.flatten(1), start, stop, frames=len(values), fps=fps)
    return values


def blend_seams_in_rotations(
    quats: Float[Tensor, "frames joints 4"], put: Bool[Tensor, "frames joints"], *, fps: float
) -> Float[Tensor, "frames joints 4"]:
    """Local rotations (xyzw) whose frames `put` were put in, joint by joint; all others stay."""
    quats = rotations.make_sign_continuous(quats)
    usual = _estimate_usual_size(_compute_rotation_second_differences(quats), put, _CALM_ANGULAR_ACCELERATION / fps**2)
    spans: dict[tuple[int, int], list[int]] = {}
    for joint, start, stop in true_intervals(put):
        spans.setdefault((start, stop), []).append(joint)
    for (start, stop), joints in spans.items():
        rows = smooth_offsets.find_overlapping_differences(start, stop, len(quats))
        if not len(rows):
            continue
        bends = _compute_rotation_second_differences(quats[rows.start : rows.stop + 2, joints])
        beyond = _compute_excess_at_edges(bends, usual[joints], start, stop, len(quats))
        moved = _solve_offset(beyond.flatten(1), start, stop, frames=len(quats), fps=fps).unflatten(1, (-1, 3))
        turned = rotations.multiply(quats[start:stop, joints], rotations.from_rotation_vector(moved))
        quats[start:stop, joints] = turned
    return rotations.make_sign_continuous(quats)


def _compute_rotation_second_differences(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "bends joints 3"]:
    """Second differences of rotations: how one frame's turn differs from the one before it, in the middle's frame."""
    turns = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[:-1]), quats[1:]))
    return torch.diff(turns, dim=0)


def _estimate_usual_size(
    bends: Float[Tensor, "bends joints width"], put: Bool[Tensor, "frames joints"], calm: float
) -> Float[Tensor, " joints"]:
    """By joint, the bend that one in five exceeds where nothing was put in. Where nothing shows how motion bends there,
    as at single keys, the one within what was put in, and a calm one at most.
    """
    sizes = bends.norm(dim=-1)
    own, inside = ~(put[:-2] | put[1:-1] | put[2:]), put[:-2] & put[1:-1] & put[2:]
    usual = []
    for joint in range(sizes.shape[1]):
        known, within = sizes[own[:, joint], joint], sizes[inside[:, joint], joint]
        if len(known):
            usual.append(known.quantile(_USUAL_QUANTILE))
        else:
            usual.append(within.quantile(_USUAL_QUANTILE).clamp(max=calm) if len(within) else sizes.new_tensor(calm))
    return torch.stack(usual)


def _compute_excess_at_edges(
    bends: Float[Tensor, "rows joints width"], usual: Float[Tensor, " joints"], start: int, stop: int, frames: int
) -> Float[Tensor, "rows joints width"]:
    """What of the bends that reach across an edge is more than usual; 0 for those within."""
    across = torch.tensor(
        [
            not (start <= row and row + 2 < stop)
            for row in smooth_offsets.find_overlapping_differences(start, stop, frames)
        ]
    )
    size = bends.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    rest = bends * (1 - usual[:, None] / size).clamp_min(0)
    return torch.where(across[:, None, None], rest, 0.0) if len(bends) else bends


def _solve_offset(
    bends: Float[Tensor, "rows width"], start: int, stop: int, *, frames: int, fps: float
) -> Float[Tensor, "gap width"]:
    """The offset of the gap's frames that takes these kinks away."""
    rows, count = smooth_offsets.find_overlapping_differences(start, stop, frames), stop - start
    known_before, known_after = start > 0, stop < frames
    if not len(rows) or not (known_before or known_after):
        return bends.new_zeros(count, bends.shape[1])
    right, errors = np.zeros((count, bends.shape[1])), bends.double().numpy()
    for number, row in enumerate(rows):
        for tap, weight in enumerate(smooth_offsets.SECOND_DIFFERENCE):
            if start <= row + tap < stop:
                right[row + tap - start] -= weight * errors[number]
    offset = smooth_offsets.solve_offsets(
        right, smooth_offsets.fade_weight(_SEAM_FADE_SECONDS, fps), start=start, frames=frames
    )
    return torch.as_tensor(offset).to(bends)
