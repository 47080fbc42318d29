"""Estimation of a recording's noise from the recording alone.

People move slowly beside a camera's noise from frame to frame, so a high difference of a channel is nearly all noise.
Its median over time shows how much, untroubled by spikes and by the moments of a landing.

Signs of quaternions, and rotations averaged over time, under noise so large that neighbouring frames do not tell.

A quaternion and its negative are one rotation. Signs are usually chosen so that neighbouring frames lie in one half of
the sphere, which fails where noise turns a joint by more than half a turn from one frame to the next: all frames after
it then have the other sign, and a filter across the flip finds a rotation that is neither.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.numerics import gaussian

_AMBIGUOUS_DOT = 0.5  # cosine of half the turn between two frames, 120 degrees, from which on they do not tell
_MEAN_FRAMES = 6.0  # frames, sigma, over which rotations are averaged: fewer can be led astray themselves


def choose_continuous_signs(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "frames joints 4"]:
    """Choose signs of the same rotations that are continuous over time: by the frame before, and for joints of which
    any frame is too far from it, by the mean of the frames around."""
    signed = rotations.make_sign_continuous(quats)
    unclear = ((signed[1:] * signed[:-1]).sum(dim=-1) < _AMBIGUOUS_DOT).any(dim=0)
    if not unclear.any():
        return signed
    noisy = signed[:, unclear]
    means = rotations.make_sign_continuous(average_over_time(noisy, torch.ones(noisy.shape[:2], dtype=torch.bool)))
    chosen = signed.clone()
    chosen[:, unclear] = torch.where((noisy * means).sum(dim=-1, keepdim=True) < 0, -noisy, noisy)
    return chosen


def average_over_time(
    quats: Float[Tensor, "frames joints 4"], seen: Bool[Tensor, "frames joints"]
) -> Float[Tensor, "frames joints 4"]:
    """Average the rotations that were observed about each frame, whatever their signs: the first eigenvector of the
    quaternions' second moment (Markley et al. 2007), weighted by a Gaussian. The sign of each mean is any."""
    outer = torch.einsum("fji,fjk->fjik", quats, quats) * seen.to(quats)[..., None, None]
    moment = gaussian.smooth(outer, _MEAN_FRAMES, ends="constant")
    size, axes = torch.linalg.eigh(moment)
    return torch.where(size[..., -1:] > 0, axes[..., -1], quats)


RESOLUTION = 1e-5
"""Radians and metres below which nothing differs: files have as few digits."""
# Orders of the differences, with the fewest runs of frames that each needs; the first that has them counts. Runs that
# many losses leave are few and short: a rough estimate by the last order is better than none.
_ORDERS = {4: 12, 3: 12, 2: 4}
_MAD_TO_SIGMA = 1.4826  # of a normal number's size
_LARGE_NOISE = 0.2  # radians: turns between two frames with more do not add up any more


def estimate_angle_noise(
    quats: Float[Tensor, "frames joints 4"], seen: Bool[Tensor, "frames joints"]
) -> Float[Tensor, " joints"]:
    """Estimate the white noise of each of a joint's three angles, radians; 0 for a recording too short. A joint that is
    never observed for some frames on end is taken to be as noisy as the others.

    Between two frames a joint turns by what it moved and by the difference of their noise. Where that is large, such
    turns end at half a turn and their differences tell too little: what each frame is away from the mean of those
    around it takes their place. Angles that are rounded to a step err uniformly by half of it, however still they seem.
    """
    steps = rotations.turns_between(quats[:-1], quats[1:])
    sigma = _estimate_sigma(steps, seen, differenced=1)
    large = sigma > _LARGE_NOISE
    if large.any():
        mean = rotations.make_sign_continuous(average_over_time(quats[:, large], seen[:, large]))
        away = rotations.turns_between(mean, quats[:, large])
        about_mean = _estimate_sigma(away, seen[:, large], differenced=0).nan_to_num(0.0)
        sigma[large] = torch.maximum(sigma[large], about_mean)
    known = sigma[(sigma > 0) & sigma.isfinite()]
    usual = known.median() if len(known) else sigma.new_zeros(())
    rounded = _find_step(steps.norm(dim=-1), seen) / math.sqrt(12)
    return torch.maximum(torch.where(sigma.isnan(), usual, sigma), rounded)


def _find_step(turns: Float[Tensor, "steps joints"], seen: Bool[Tensor, "frames joints"]) -> Float[Tensor, " joints"]:
    """Find the step to which a joint's angles are rounded, radians; 0 where they are not. One angle that changes by a
    step turns the joint by just that, whatever the order of its angles: of the turns between two rests, most are equal,
    and none is smaller."""
    if len(turns) < 3:
        return turns.new_zeros(turns.shape[1])
    rests = turns < RESOLUTION
    alone = rests[:-2] & ~rests[1:-1] & rests[2:] & _observed_windows(seen, 4)
    sizes = torch.where(alone, turns[1:-1], math.nan)
    step = torch.where(alone, sizes, math.inf).amin(dim=0)
    rounded = (sizes.nanmedian(dim=0).values - step < RESOLUTION) & (alone.sum(dim=0) > 2)
    return torch.where(rounded, step, 0.0)


def estimate_position_noise(positions: Float[Tensor, "frames 3"], seen: Bool[Tensor, " frames"]) -> float:
    """Estimate the white noise of each coordinate, in the positions' unit; 0 for a recording too short."""
    return float(_estimate_sigma(positions[:, None], seen[:, None], differenced=0).nan_to_num(0.0))


def _estimate_sigma(
    values: Float[Tensor, "some joints 3"], seen: Bool[Tensor, "frames joints"], *, differenced: int
) -> Tensor:
    """Estimate sigma by joint, from differences of the highest order with enough runs; NaN where there are not.
    `values` are differences of that order already."""
    sigma = torch.full((values.shape[1],), math.nan, dtype=values.dtype)
    for order, fewest in _ORDERS.items():
        differences, used = torch.diff(values, n=order - differenced, dim=0), _observed_windows(seen, order + 1)
        if len(differences) == 0:
            continue
        # Not of a whole that is shorter, which has nothing better.
        enough = used.sum(dim=0) >= min(fewest, len(used))
        found = _robust_sigma(differences, used) / math.sqrt(math.comb(2 * order, order))
        sigma = torch.where(sigma.isnan() & enough, found, sigma)
    return sigma if len(values) > min(_ORDERS) else torch.zeros_like(sigma)


def _observed_windows(seen: Bool[Tensor, "frames joints"], length: int) -> Bool[Tensor, "runs joints"]:
    """Return whether each run of `length` frames was observed throughout."""
    if len(seen) < length:
        return seen[:0]
    return seen.unfold(0, length, 1).all(dim=-1)


def _robust_sigma(
    differences: Float[Tensor, "runs joints 3"], used: Bool[Tensor, "runs joints"]
) -> Float[Tensor, " joints"]:
    """Return sigma from the median along a joint's principal axes: near gimbal lock only two of them are noisy."""
    size = differences.norm(dim=-1)
    size = torch.where(used, size, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    # Spikes would turn the axes their way.
    clipped = differences * (3 * size / differences.norm(dim=-1).clamp_min(1e-12)).clamp(max=1)[..., None]
    clipped = clipped * used[..., None]
    axes = torch.linalg.eigh(torch.einsum("fja,fjb->jab", clipped, clipped)).eigenvectors
    along = torch.einsum("fja,jab->fjb", differences, axes).abs()
    median = torch.where(used[..., None], along, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    return torch.sqrt((_MAD_TO_SIGMA * median).square().mean(dim=-1))
