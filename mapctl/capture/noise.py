"""How noisy a recording is, told from the recording alone.

People move slowly beside a camera's noise from frame to frame, so a high difference of a channel is nearly all noise.
Its median over time says how much, untroubled by spikes and by the moments of a landing.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations

_ORDER = 4
_GAIN = math.comb(2 * _ORDER, _ORDER)  # a difference of this order has so many times white noise's variance
_SIGMAS_A_MEDIAN = 1.4826  # of a normal number's size


def angle_noise(
    quats: Float[Tensor, "frames joints 4"], seen: Bool[Tensor, "frames joints"]
) -> Float[Tensor, " joints"]:
    """White noise of each of a joint's three angles, radians; 0 of a recording too short to tell.

    Between two frames a joint turns by what it moved and by the difference of their noise.
    """
    steps = rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[:-1]), quats[1:]))
    return _sigma(_differences(steps, _ORDER - 1), _runs(seen, _ORDER + 1))


def place_noise(places: Float[Tensor, "frames 3"], seen: Bool[Tensor, " frames"]) -> float:
    """White noise of each coordinate, in the places' unit; 0 of a recording too short to tell."""
    differences = _differences(places, _ORDER)[:, None]
    return float(_sigma(differences, _runs(seen[:, None], _ORDER + 1)))


def _differences(values: Tensor, order: int) -> Tensor:
    for _ in range(order):
        values = torch.diff(values, dim=0)
    return values


def _runs(seen: Bool[Tensor, "frames joints"], length: int) -> Bool[Tensor, "runs joints"]:
    """Whether each run of `length` frames was seen throughout."""
    if len(seen) < length:
        return seen[:0]
    return seen.unfold(0, length, 1).all(dim=-1)


def _sigma(differences: Float[Tensor, "runs joints 3"], used: Bool[Tensor, "runs joints"]) -> Float[Tensor, " joints"]:
    """From the median along each of a joint's principal axes: a rig near gimbal lock shakes about two of them only."""
    if len(differences) == 0:
        return differences.new_zeros(differences.shape[1])
    size = differences.norm(dim=-1)
    size = torch.where(used, size, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    # Spikes would turn the axes their way.
    clipped = differences * (3 * size / differences.norm(dim=-1).clamp_min(1e-12)).clamp(max=1)[..., None]
    clipped = clipped * used[..., None]
    axes = torch.linalg.eigh(torch.einsum("fja,fjb->jab", clipped, clipped)).eigenvectors
    along = torch.einsum("fja,jab->fjb", differences, axes).abs()
    median = torch.where(used[..., None], along, math.nan).nanmedian(dim=0).values.nan_to_num(0.0)
    return torch.sqrt((_SIGMAS_A_MEDIAN * median).square().mean(dim=-1) / _GAIN)
