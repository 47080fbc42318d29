"""The smoothest offsets of some frames: least second differences, each frame held as firmly as its weight.

Errors of a motion at keys, targets, contacts and seams are removed by these: `interpolate_offsets` for positions and
`interpolate_turns` for rotations where the misses are known, `blend_seams_in_positions` and `blend_seams_in_rotations`
where new frames meet known ones. The trajectory over the ground is closed otherwise (`root_trajectory.close_path`):
there the smoothest offsets would make standing bodies slide.
"""

import math

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from mapctl import rotations
from mapctl.numerics.intervals import true_intervals

_CONSTRAINT_WEIGHT = 1e9  # how much more a given value counts than smoothness
_SECOND_DIFFERENCE = (1.0, -2.0, 1.0)
_SEAM_FADE_SECONDS = 0.1  # seconds over which an offset fades away from its edge
_USUAL_QUANTILE = 0.8
_CALM_ACCELERATION, _CALM_ANGULAR_ACCELERATION = 1.2, 9.0  # m/s^2 and rad/s^2 that are usual in any motion


def _find_rows(start: int, stop: int, frames: int) -> range:
    """Find the first frames of the second differences, of so many frames, that take in some of start to stop."""
    return range(max(0, start - 2), min(frames - 2, stop))


def _fade_weight(seconds: float, fps: float) -> float:
    """Return how firmly frames are held at 0 where offsets are to fade away over this time."""
    return 1.0 / max(1.0, seconds * fps) ** 4


def solve_offsets(
    right: Float[ndarray, "count width"], firm: float | Float[ndarray, " count"], *, start: int, frames: int
) -> Float[ndarray, "count width"]:
    """Solve for offsets o of frames from `start` on, with  (D'D + diag(firm)) o = right,  D the second differences of a
    motion of so many frames, of which all others have no offset."""
    count = len(right)
    first = np.array(_find_rows(start, start + count, frames), dtype=int) - start
    bands = np.zeros((3, count))
    for tap, weight in enumerate(_SECOND_DIFFERENCE):
        for beside in range(3 - tap):
            held = first[(first + tap >= 0) & (first + tap + beside < count)] + tap + beside
            bands[2 - beside, held] += weight * _SECOND_DIFFERENCE[tap + beside]
    bands[2] += firm
    return scipy.linalg.solveh_banded(bands, right)


def interpolate_offsets(
    values: Float[Tensor, "frames width"], firm: Bool[Tensor, " frames"], *, seconds: float, fps: float
) -> Float[Tensor, "frames width"]:
    """Interpolate the smoothest offsets that have the values in the frames that are firm, and fade to 0 away from them
    over about so many seconds: a value v then asks for an acceleration of v / seconds^2. They do not fade if `seconds`
    are infinite: then at least two frames must be firm."""
    count = len(values)
    if count < 3:
        return torch.where(firm[:, None], values, 0.0)
    weight = _fade_weight(seconds, fps) + _CONSTRAINT_WEIGHT * firm.double().numpy()
    right = _CONSTRAINT_WEIGHT * (values * firm[:, None]).double().numpy()
    return torch.as_tensor(solve_offsets(right, weight, start=0, frames=count)).to(values)


def interpolate_turns(
    current_xyzw: Float[Tensor, "frames joints 4"],
    wanted_xyzw: Float[Tensor, "frames joints 4"],
    firm: Bool[Tensor, "frames joints"],
    *,
    seconds: float,
    fps: float,
) -> Float[Tensor, "frames joints 4"]:
    """Turn joints, smoothly over the frames around, until they are as wanted in the frames in which they are firm, as
    `interpolate_offsets` does; joints that are never firm stay. `wanted_xyzw` may hold anything finite elsewhere."""
    off = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(current_xyzw), wanted_xyzw))
    offsets = torch.zeros_like(off)
    for pattern in firm.T.unique(dim=0):
        if bool(pattern.any()):
            joints = (pattern == firm.T).all(dim=1)
            solved = interpolate_offsets(off[:, joints].flatten(1), pattern, seconds=seconds, fps=fps)
            offsets[:, joints] = solved.unflatten(1, (-1, 3))
    return rotations.multiply(current_xyzw, rotations.from_rotation_vector(offsets))


def smooth_between(
    values: Float[Tensor, "frames width"], held: Bool[Tensor, " frames"], *, hertz: float, fps: float
) -> Float[Tensor, "frames width"]:
    """Smooth values by the offsets that leave least second differences, with none in the frames that are held: of what
    trembles at this frequency half is left, of slower motion nearly all (Whittaker 1923). `hertz` is at most half of
    `fps`."""
    if len(values) < 3:
        return values
    bends = torch.diff(values.double(), n=2, dim=0).numpy()
    right = np.zeros(values.shape)
    for tap, weight in enumerate(_SECOND_DIFFERENCE):
        right[tap : tap + len(bends)] -= weight * bends
    firm = (2 * math.sin(math.pi * hertz / fps)) ** 4 + _CONSTRAINT_WEIGHT * held.double().numpy()
    offsets = torch.as_tensor(solve_offsets(right, firm, start=0, frames=len(values))).to(values)
    return torch.where(held[:, None], values, values + offsets)


def blend_seams_in_positions(
    values: Float[Tensor, "frames width"], new: Bool[Tensor, " frames"], *, fps: float
) -> Float[Tensor, "frames width"]:
    """Blend the seams of `new` frames in positions until position and velocity are continuous at both edges; all others
    stay. The offset o of a gap solves  min |D o + e|^2 + eps |o|^2,  D the second differences, e those of the motion
    across an edge, by their excess over the motion's usual ones, and 0 within: the motion keeps its shape, and a
    continuous seam stays unchanged."""
    values, frames = values.clone(), len(values)
    usual = _estimate_usual_size(torch.diff(values, n=2, dim=0)[:, None], new[:, None], _CALM_ACCELERATION / fps**2)
    for _, start, stop in true_intervals(new[:, None]):
        if len(rows := _find_rows(start, stop, frames)):
            differences = torch.diff(values[rows.start : rows.stop + 2], n=2, dim=0)[:, None]
            values[start:stop] += _solve_seam(differences, usual, start, stop, frames, fps)[:, 0]
    return values


def blend_seams_in_rotations(
    quats: Float[Tensor, "frames joints 4"], new: Bool[Tensor, "frames joints"], *, fps: float
) -> Float[Tensor, "frames joints 4"]:
    """Blend the seams of `new` frames in local rotations (xyzw), joint by joint, as those of positions."""
    quats, frames = rotations.make_sign_continuous(quats), len(quats)
    usual = _estimate_usual_size(_rotation_differences(quats), new, _CALM_ANGULAR_ACCELERATION / fps**2)
    spans: dict[tuple[int, int], list[int]] = {}
    for joint, start, stop in true_intervals(new):
        spans.setdefault((start, stop), []).append(joint)
    for (start, stop), joints in spans.items():
        if len(rows := _find_rows(start, stop, frames)):
            differences = _rotation_differences(quats[rows.start : rows.stop + 2, joints])
            offsets = _solve_seam(differences, usual[joints], start, stop, frames, fps)
            turns = rotations.from_rotation_vector(offsets)
            quats[start:stop, joints] = rotations.multiply(quats[start:stop, joints], turns)
    return rotations.make_sign_continuous(quats)


def _rotation_differences(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "bends joints 3"]:
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


def _solve_seam(
    differences: Float[Tensor, "rows joints width"],
    usual: Float[Tensor, " joints"],
    start: int,
    stop: int,
    frames: int,
    fps: float,
) -> Float[Tensor, "gap joints width"]:
    """Solve for the offset of the gap's frames that removes the excess of second differences across its edges."""
    first, count = np.array(_find_rows(start, stop, frames)), stop - start
    if count == frames:
        return differences.new_zeros(count, *differences.shape[1:])
    across = torch.from_numpy((first < start) | (first + 2 >= stop))
    size = differences.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    excess = torch.where(across[:, None, None], differences * (1 - usual[:, None] / size).clamp_min(0), 0.0)
    errors = excess.flatten(1).double().numpy()
    right = np.zeros((count, errors.shape[1]))
    for tap in (2, 1, 0):
        at = first + tap - start
        inside = (at >= 0) & (at < count)
        right[at[inside]] -= _SECOND_DIFFERENCE[tap] * errors[inside]
    offset = solve_offsets(right, _fade_weight(_SEAM_FADE_SECONDS, fps), start=start, frames=frames)
    return torch.as_tensor(offset).to(differences).unflatten(1, differences.shape[1:])
