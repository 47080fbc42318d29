"""Seam blending of a gap: new frames are offset, smoothly and by as little as possible, until position and velocity are
continuous at both edges.

The offset o of a gap's frames solves  min |D o + e|^2 + eps |o|^2,  D the second differences, e those of the motion
across an edge, by their excess over the motion's usual ones, and 0 within: discontinuities at the edges vanish, the
motion within keeps its shape, and a continuous seam stays unchanged.
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
_CALM_ACCELERATION, _CALM_ANGULAR_ACCELERATION = 1.2, 9.0  # m/s^2 and rad/s^2 that are usual in any motion


def blend_seams_in_positions(
    values: Float[Tensor, "frames width"], new: Bool[Tensor, " frames"], *, fps: float
) -> Float[Tensor, "frames width"]:
    """Blend the seams of `new` frames in positions; all others stay."""
    values = values.clone()
    usual = _estimate_usual_size(torch.diff(values, n=2, dim=0)[:, None], new[:, None], _CALM_ACCELERATION / fps**2)
    for _, start, stop in true_intervals(new[:, None]):
        rows = smooth_offsets.find_overlapping_differences(start, stop, len(values))
        differences = (
            torch.diff(values[rows.start : rows.stop + 2], n=2, dim=0)[:, None] if len(rows) else values[:0, None]
        )
        excess = _compute_excess_at_edges(differences, usual, start, stop, len(values))
        values[start:stop] += _solve_offset(excess.flatten(1), start, stop, frames=len(values), fps=fps)
    return values


def blend_seams_in_rotations(
    quats: Float[Tensor, "frames joints 4"], new: Bool[Tensor, "frames joints"], *, fps: float
) -> Float[Tensor, "frames joints 4"]:
    """Blend the seams of `new` frames in local rotations (xyzw), joint by joint; all others stay."""
    quats = rotations.make_sign_continuous(quats)
    usual = _estimate_usual_size(_compute_rotation_second_differences(quats), new, _CALM_ANGULAR_ACCELERATION / fps**2)
    spans: dict[tuple[int, int], list[int]] = {}
    for joint, start, stop in true_intervals(new):
        spans.setdefault((start, stop), []).append(joint)
    for (start, stop), joints in spans.items():
        rows = smooth_offsets.find_overlapping_differences(start, stop, len(quats))
        if not len(rows):
            continue
        differences = _compute_rotation_second_differences(quats[rows.start : rows.stop + 2, joints])
        excess = _compute_excess_at_edges(differences, usual[joints], start, stop, len(quats))
        offsets = _solve_offset(excess.flatten(1), start, stop, frames=len(quats), fps=fps).unflatten(1, (-1, 3))
        blended = rotations.multiply(quats[start:stop, joints], rotations.from_rotation_vector(offsets))
        quats[start:stop, joints] = blended
    return rotations.make_sign_continuous(quats)


def _compute_rotation_second_differences(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "bends joints 3"]:
    """Compute second differences of rotations: those of the rotation vectors from frame to frame."""
    turns = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[:-1]), quats[1:]))
    return torch.diff(turns, dim=0)


def _estimate_usual_size(
    differences: Float[Tensor, "bends joints width"], new: Bool[Tensor, "frames joints"], calm: float
) -> Float[Tensor, " joints"]:
    """Estimate by joint the 80th percentile of second differences outside new frames. Where there are none, as at
    single keys, take the one within new frames, and a calm one at most.
    """
    sizes = differences.norm(dim=-1)
    own, inside = ~(new[:-2] | new[1:-1] | new[2:]), new[:-2] & new[1:-1] & new[2:]
    usual = []
    for joint in range(sizes.shape[1]):
        known, within = sizes[own[:, joint], joint], sizes[inside[:, joint], joint]
        if len(known):
            usual.append(known.quantile(_USUAL_QUANTILE))
        else:
            usual.append(within.quantile(_USUAL_QUANTILE).clamp(max=calm) if len(within) else sizes.new_tensor(calm))
    return torch.stack(usual)


def _compute_excess_at_edges(
    differences: Float[Tensor, "rows joints width"], usual: Float[Tensor, " joints"], start: int, stop: int, frames: int
) -> Float[Tensor, "rows joints width"]:
    """Compute the excess of second differences across an edge over the usual ones; 0 for those within."""
    rows = smooth_offsets.find_overlapping_differences(start, stop, frames)
    across = torch.tensor([not (start <= row and row + 2 < stop) for row in rows])
    size = differences.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    rest = differences * (1 - usual[:, None] / size).clamp_min(0)
    return torch.where(across[:, None, None], rest, 0.0) if len(differences) else differences


def _solve_offset(
    differences: Float[Tensor, "rows width"], start: int, stop: int, *, frames: int, fps: float
) -> Float[Tensor, "gap width"]:
    """Solve for the offset of the gap's frames that removes these second differences."""
    rows, count = smooth_offsets.find_overlapping_differences(start, stop, frames), stop - start
    known_before, known_after = start > 0, stop < frames
    if not len(rows) or not (known_before or known_after):
        return differences.new_zeros(count, differences.shape[1])
    right, errors = np.zeros((count, differences.shape[1])), differences.double().numpy()
    for number, row in enumerate(rows):
        for tap, weight in enumerate(smooth_offsets.SECOND_DIFFERENCE):
            if start <= row + tap < stop:
                right[row + tap - start] -= weight * errors[number]
    offset = smooth_offsets.solve_offsets(
        right, smooth_offsets.fade_weight(_SEAM_FADE_SECONDS, fps), start=start, frames=frames
    )
    return torch.as_tensor(offset).to(differences)
