"""Estimation of a pose blended into the frames after it: its weight in each frame, from all joints at once.

Each frame is the pose, the motion and one weight that all joints share: what noise hides in a joint, the others show.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations

_MIN_NOISE = math.radians(0.2)  # noise of an angle in the best of captures
_SECOND_DIFFERENCE_SIGMA = 0.1  # of second differences of the shares
_DEVIATION_SIGMA = 0.3  # height of a bow, of the length of the way
_NOISE_FACTOR = 3.0  # times the noise's power that is left in most frames before any of it is kept
_ITERATIONS = 5  # of weighing anew what does not fit


def estimate_blend_weights(
    pose: Float[Tensor, "1 joints 4"],
    ahead: Float[Tensor, "frames joints 4"],
    seen: Float[Tensor, "frames joints 4"],
    *,
    noise: Float[Tensor, " joints"],
    counts: Bool[Tensor, "frames joints"],
) -> Float[Tensor, " frames"]:
    """Estimate the blend weight of each frame, 0 at the pose to 1 at the motion ahead.

    By least squares over the joints, without those that go another way, and as evenly over time as noise makes it;
    after the last frame all of it has been gone.
    """
    whole, gone, usual = (
        _relative_rotation_vector(pose, ahead),
        _relative_rotation_vector(pose, seen),
        _floor_noise(noise),
    )
    trust = counts / usual.square()
    share, known = torch.full((len(seen),), 0.5, dtype=seen.dtype), torch.ones(len(seen), dtype=seen.dtype)
    for _ in range(_ITERATIONS):
        away = (gone - share[:, None, None] * whole).norm(dim=-1)
        fits = trust * (2 * math.sqrt(3.0) * usual / away.clamp_min(1e-9)).clamp(max=1.0)
        known = (fits[..., None] * whole.square()).sum(dim=(-1, -2)).clamp_min(1e-6)
        share = (fits[..., None] * whole * gone).sum(dim=(-1, -2)) / known
    return _smooth_weights(share, known).clamp(0, 1)


def blend_poses(pose: Tensor, ahead: Tensor, share: Float[Tensor, " frames"]) -> Float[Tensor, "frames joints 4"]:
    """Blend the pose and the motion along the shortest arc."""
    turn = rotations.from_rotation_vector(share[:, None, None] * _relative_rotation_vector(pose, ahead))
    return rotations.multiply(pose.expand_as(turn), turn)


def estimate_geodesic_deviation(
    along: Tensor,
    seen: Tensor,
    share: Float[Tensor, " frames"],
    *,
    noise: Float[Tensor, " joints"],
    whole: Float[Tensor, "frames joints"],
    counts: Bool[Tensor, "frames joints"],
) -> Float[Tensor, "frames joints 3"]:
    """Estimate how far the path from pose to motion leaves the shortest arc, as Euler angles blended one by one do: one
    bow a joint, highest half-way, and what else there is in most frames, as far as it exceeds the noise. `whole` is the
    length of the shortest arc, radians."""
    shape = (4 * share * (1 - share))[:, None, None]
    rest, trust = _relative_rotation_vector(along, seen), counts[..., None].double()
    noise = _floor_noise(noise)
    usual = noise[None, :, None] * math.sqrt(3.0)
    likely = (noise / (_DEVIATION_SIGMA * whole.amax(dim=0)).clamp_min(1e-6)).square()[
        :, None
    ]  # a short way has a small bow
    bow, power = rest.new_zeros(rest.shape[1:]), likely
    for _ in range(_ITERATIONS):  # what lies far from the bow, as a spike does, counts less
        fits = trust * (2 * usual / (rest - shape * bow).norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp(max=1.0)
        power = (fits * shape.square()).sum(dim=0) + likely
        bow = (fits * shape * rest).sum(dim=0) / power
    chance = usual[0].square() / power
    bowed = shape * bow * (1 - chance / bow.square().sum(dim=-1, keepdim=True).clamp_min(1e-12)).clamp_min(0.0)
    left = trust * (rest - bowed)
    # In most frames, so that a spike in one is none of it.
    power = left.square().sum(dim=-1, keepdim=True).median(dim=0).values
    return bowed + left * (1 - _NOISE_FACTOR * usual[0].square() / power.clamp_min(1e-12)).clamp_min(0.0)


def angle_between(first: Tensor, second: Tensor) -> Tensor:
    """Return angles between rotations, radians."""
    return _relative_rotation_vector(first, second).norm(dim=-1)


def extrapolate_linear(values: Float[Tensor, "frames *width"], first: int, count: int, *, upto: int) -> Tensor:
    """Extrapolate frames 1 to `upto` by the line through so many frames from `first` on."""
    weights = torch.stack([linear_fit_weights(count, float(frame - first)) for frame in range(1, upto + 1)])
    return torch.einsum("kn,n...->k...", weights, values[first : first + count])


def linear_fit_weights(count: int, at: float) -> Float[Tensor, " count"]:
    """Return the weights of values at 0, 1, ... in the value `at` of the line through them."""
    place = torch.arange(count, dtype=torch.float64)
    middle = place.mean()
    spread = (place - middle).square().sum().clamp_min(1.0)
    return 1 / count + (at - middle) * (place - middle) / spread


def _floor_noise(noise: Float[Tensor, " joints"]) -> Float[Tensor, " joints"]:
    """Give joints that never move, and seem to have no noise, as much as is at all likely."""
    known = noise[noise > 0]
    usual = float(known.median()) / 2 if len(known) else 0.0
    return noise.clamp_min(max(usual, _MIN_NOISE))


def _smooth_weights(share: Float[Tensor, " frames"], known: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Smooth weights known to 1 / sqrt(known): from 0 before the first to 1 after the last."""
    count = len(share)
    second = torch.zeros(count, count + 2, dtype=share.dtype)
    for row in range(count):
        second[row, row : row + 3] = torch.tensor([1.0, -2.0, 1.0], dtype=share.dtype)
    within = second[:, 1:-1]
    left = within.T @ within / _SECOND_DIFFERENCE_SIGMA**2 + torch.diag(known)
    return torch.linalg.solve(left, known * share - within.T @ second[:, -1] / _SECOND_DIFFERENCE_SIGMA**2)


def _relative_rotation_vector(start: Tensor, stop: Tensor) -> Tensor:
    """Return rotation vectors from one to the other, in the first's frame."""
    return rotations.to_rotation_vector(rotations.multiply(rotations.inverse(start).expand_as(stop), stop))
