"""The smoothest offsets of some frames: least second differences, each frame held as firmly as its weight says.

What a motion misses keys, targets, contacts and seams by is made good by these everywhere: by `interpolate_offsets` of
places and `interpolate_turns` of rotations where the misses are known. Two are not told so: a seam between poses that
both are right (`inbetweening.seam_blending`), whose bend is to vanish and whose offset is what comes out, by the same
equations; and the way over the ground (`inbetweening.path_closing`), whose offsets go with the way walked, since the
smoothest ones make who stands slide.
"""

import math

import numpy as np
import scipy
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from mapctl import rotations

_CONSTRAINT_WEIGHT = 1e9  # how much more a given value counts than smoothness
SECOND_DIFFERENCE = (1.0, -2.0, 1.0)
"""Weights of three frames in a second difference."""


def find_overlapping_differences(start: int, stop: int, frames: int) -> range:
    """Find the first frames of the second differences, of a motion of so many frames, that take in some of start to
    stop."""
    return range(max(0, start - 2), min(frames - 2, stop))


def fade_weight(seconds: float, fps: float) -> float:
    """Return how firmly frames are held at 0 where offsets are to fade away over this time."""
    return 1.0 / max(1.0, seconds * fps) ** 4


def solve_offsets(
    right: Float[ndarray, "count width"], firm: float | Float[ndarray, " count"], *, start: int, frames: int
) -> Float[ndarray, "count width"]:
    """Solve for offsets o of frames from `start` on, with  (D'D + diag(firm)) o = right,  D the second differences of a
    motion of so many frames, of which all others have no offset."""
    count = len(right)
    first = np.array(find_overlapping_differences(start, start + count, frames), dtype=int) - start
    bands = np.zeros((3, count))
    for tap, weight in enumerate(SECOND_DIFFERENCE):
        for beside in range(3 - tap):
            held = first[(first + tap >= 0) & (first + tap + beside < count)] + tap + beside
            bands[2 - beside, held] += weight * SECOND_DIFFERENCE[tap + beside]
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
    weight = fade_weight(seconds, fps) + _CONSTRAINT_WEIGHT * firm.double().numpy()
    right = _CONSTRAINT_WEIGHT * (values * firm[:, None]).double().numpy()
    return torch.as_tensor(solve_offsets(right, weight, start=0, frames=count)).to(values)


def interpolate_turns(
    made_xyzw: Float[Tensor, "frames joints 4"],
    wanted_xyzw: Float[Tensor, "frames joints 4"],
    firm: Bool[Tensor, "frames joints"],
    *,
    seconds: float,
    fps: float,
) -> Float[Tensor, "frames joints 4"]:
    """Turn joints, smoothly over the frames around, until they are as wanted in the frames in which they are firm, as
    `interpolate_offsets` does; joints that are never firm stay. `wanted_xyzw` may hold anything finite elsewhere."""
    off = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(made_xyzw), wanted_xyzw))
    offsets = torch.zeros_like(off)
    for pattern in firm.T.unique(dim=0):
        if bool(pattern.any()):
            joints = (pattern == firm.T).all(dim=1)
            solved = interpolate_offsets(off[:, joints].flatten(1), pattern, seconds=seconds, fps=fps)
            offsets[:, joints] = solved.unflatten(1, (-1, 3))
    return rotations.multiply(made_xyzw, rotations.from_rotation_vector(offsets))


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
    for tap, weight in enumerate(SECOND_DIFFERENCE):
        right[tap : tap + len(bends)] -= weight * bends
    firm = (2 * math.sin(math.pi * hertz / fps)) ** 4 + _CONSTRAINT_WEIGHT * held.double().numpy()
    offsets = torch.as_tensor(solve_offsets(right, firm, start=0, frames=len(values))).to(values)
    return torch.where(held[:, None], values, values + offsets)
