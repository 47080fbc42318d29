"""Detection of spikes: single frames, or two in a row, that lie far from all around them."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.recording.quaternion_signs import choose_continuous_signs

_MEDIAN_FRAMES = 5  # frames of the running median: bursts of up to two are detected
_STEP_FRAMES = 6  # frames on either side that tell how fast a joint is moving
MIN_SPIKE_SIGMAS = 5.0
"""Least distance of a spike from the median of its surroundings, in sigmas of the noise."""
MIN_SPIKE_DEG = 12.0
"""Least height of a spike, degrees, or as many centimetres: less is left to what treats noise."""
LEAST_NOISE = math.radians(1.0)
"""Noise of a joint below which it is taken for one without."""
_RESIDUAL_SIGMAS, _RESIDUAL_DEG = (
    4.8,
    3.0,
)  # of a spike in the residual: one in 5,000 of normal noise is as far from its median
_STEP_FACTOR = (
    2.0  # and so many times the usual way between frames about there: the turning point of a fast kick is none
)


def find_angle_spikes(
    quats: Float[Tensor, "frames joints 4"], sigma: Float[Tensor, " joints"]
) -> Bool[Tensor, "frames joints"]:
    """Find which joints spike in which frames; `sigma` is the noise of each angle, radians."""
    quats = choose_continuous_signs(quats)
    middle = _running_median(quats.flatten(1)).unflatten(1, quats.shape[1:])
    middle = torch.nn.functional.normalize(_continue_at_ends(middle, quats, sigma < LEAST_NOISE), dim=-1)
    away = _rotation_distance(middle, quats)
    usual = _mean_step(_rotation_distance(middle[:-1], middle[1:]))
    return away > (MIN_SPIKE_SIGMAS * sigma).clamp_min(math.radians(MIN_SPIKE_DEG)) + _STEP_FACTOR * usual


def find_position_spikes(places: Float[Tensor, "frames 3"], sigma: float) -> Bool[Tensor, " frames"]:
    """Find the frames in which the position spikes; metres."""
    middle = _running_median(places)
    away = (places - middle).norm(dim=-1)
    usual = _mean_step(torch.diff(middle, dim=0).norm(dim=-1)[:, None])[:, 0]
    return away > max(MIN_SPIKE_SIGMAS * sigma, MIN_SPIKE_DEG / 100) + _STEP_FACTOR * usual


def find_residual_spikes(
    rest: Float[Tensor, "frames joints 3"], sigma: Float[Tensor, " joints"]
) -> Bool[Tensor, "frames joints"]:
    """Find spikes in the residual of a capture beside a model of it: rotation vectors, radians. Without the motion
    itself a spike stands out more clearly; `sigma` is the noise of each of the three numbers."""
    return (rest - _running_median(rest.flatten(1)).unflatten(1, rest.shape[1:])).norm(
        dim=-1
    ) > _RESIDUAL_SIGMAS * sigma + math.radians(_RESIDUAL_DEG)


def _running_median(values: Float[Tensor, "frames width"]) -> Float[Tensor, "frames width"]:
    """Return the running median over `_MEDIAN_FRAMES`; the ends are mirrored, since repeated, an outermost frame that
    spikes would be its own median."""
    side, last = _MEDIAN_FRAMES // 2, len(values) - 1
    frame = last - (last - torch.arange(-side, len(values) + side).abs()).abs()
    return values[frame.clamp_min(0)].unfold(0, _MEDIAN_FRAMES, 1).median(dim=-1).values


def _continue_at_ends(
    middle: Float[Tensor, "frames joints 4"], quats: Float[Tensor, "frames joints 4"], clean: Bool[Tensor, " joints"]
) -> Float[Tensor, "frames joints 4"]:
    """Return medians that go on along the line through the next two frames where an outermost frame is nearer to that:
    a joint that swings through the first frame does not turn there. With noise the line is too uncertain."""
    if len(quats) >= _MEDIAN_FRAMES:
        for end, near, far in ((0, 1, 2), (-1, -2, -3)):
            line = 2 * quats[near] - quats[far]
            nearer = (quats[end] - line).norm(dim=-1) < (quats[end] - middle[end]).norm(dim=-1)
            middle[end] = torch.where((nearer & clean)[:, None], line, middle[end])
    return middle


def _mean_step(steps: Float[Tensor, "steps joints"]) -> Float[Tensor, "frames joints"]:
    """Return the mean step between frames about each frame, of the medians."""
    if len(steps) == 0:
        return steps.new_zeros(1, steps.shape[1])
    padded = torch.nn.functional.pad(steps.T, (_STEP_FRAMES, _STEP_FRAMES - 1), mode="replicate")
    return torch.nn.functional.pad(padded.unfold(-1, 2 * _STEP_FRAMES, 1).mean(-1), (0, 1), mode="replicate").T


def _rotation_distance(start: Float[Tensor, "frames joints 4"], stop: Float[Tensor, "frames joints 4"]) -> Tensor:
    """Return the angle between two rotations, radians."""
    dots = (start * stop).sum(-1).abs().clamp(max=1)
    return 2 * torch.arccos(dots)
