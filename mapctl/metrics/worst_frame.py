"""Worst frames: the fastest hand, the largest acceleration, and how long a body moves without support.

Means hide all three: a hand that jumps by half a metre in one frame of two hundred hardly moves the mean.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts

_NEAR_FLOOR = 0.05  # height of the lower toe over its floor, metres, above which the body flies
_LOW, _SLOW = 0.03, 0.35  # limits of a supporting toe's height, metres, and speed, m/s
_MOVING_SPEED = 0.3  # speed of moving hips, m/s


class Peaks(NamedTuple):
    """Peaks of hands and feet relative to the hips."""

    step: float
    """Largest displacement in a thirtieth of a second, metres."""
    acceleration: float
    """Largest acceleration, m/s^2."""


def measure_peaks(ends: Float[Tensor, "frames ends 3"], hips: Float[Tensor, "frames 3"], fps: float) -> Peaks:
    """Measure peaks of world positions in metres; 0 for clips of too few frames."""
    relative = ends - hips[:, None]
    steps, changes = (torch.diff(relative, n=order, dim=0).norm(dim=-1) for order in (1, 2))
    step, change = (float(sizes.max()) if sizes.numel() else 0.0 for sizes in (steps, changes))
    return Peaks(step * fps / 30, change * fps**2)


def find_unsupported(
    toes: Float[Tensor, "frames feet 3"], hips: Float[Tensor, "frames 3"], fps: float
) -> Bool[Tensor, " steps"]:
    """Return by frame but the first whether the hips move over the ground while no toe is planted and the lower one is
    near its floor: the body slides, it does not fly. World positions in metres; the floor is each toe's own 5th
    percentile."""
    height = (toes[..., 1] - contacts.estimate_floor_heights(toes))[1:]
    speed, pace = (torch.diff(positions[..., ::2], dim=0).norm(dim=-1) * fps for positions in (toes, hips))
    planted = ((height < _LOW) & (speed < _SLOW)).any(dim=1)
    return ~planted & (height.amin(dim=1) < _NEAR_FLOOR) & (pace > _MOVING_SPEED)


def measure_longest_unsupported(
    toes: Float[Tensor, "frames feet 3"], hips: Float[Tensor, "frames 3"], fps: float
) -> float:
    """Measure the longest run of `find_unsupported`, seconds."""
    longest = run = 0
    for bad in find_unsupported(toes, hips, fps).tolist():
        run = run + 1 if bad else 0
        longest = max(longest, run)
    return longest / fps
