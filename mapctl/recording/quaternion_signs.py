"""Signs of quaternions, and rotations averaged over time, under noise so large that neighbouring frames do not tell.

A quaternion and its negative are one rotation. Signs are usually chosen so that neighbouring frames lie in one half of
the sphere, which fails where noise turns a joint by more than half a turn from one frame to the next: all frames after
it then have the other sign, and a filter that goes over the place finds a rotation that is neither.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.numerics import gaussian

_AMBIGUOUS_DOT = 0.5  # cosine of half the turn between two frames, 120 degrees, from which on they do not tell
_MEAN_FRAMES = 6.0  # frames, sigma, over which rotations are averaged: fewer can be led astray themselves
_SQUARINGS = 4  # of the second moment, whose 16th power leaves its first eigenvector


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
    kernel = gaussian.kernel(_MEAN_FRAMES, round(3 * _MEAN_FRAMES))
    outer = torch.einsum("fji,fjk->fjik", quats, quats) * seen.to(quats)[..., None, None]
    power = gaussian.convolve(outer.flatten(2), kernel, "nothing").unflatten(-1, (4, 4))
    for _ in range(_SQUARINGS):
        power = power / power.flatten(2).norm(dim=-1).clamp_min(1e-12)[..., None, None]
        power = power @ power
    # Each column is the eigenvector times one of its numbers: the longest is the least rounded.
    longest = power.norm(dim=-2).argmax(dim=-1)
    column = torch.take_along_dim(power, longest[..., None, None], dim=-1)[..., 0]
    size = column.norm(dim=-1, keepdim=True)
    return torch.where(size > 0, column / size.clamp_min(1e-30), quats)
