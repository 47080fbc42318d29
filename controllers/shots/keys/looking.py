"""Heads that look at something for a time: they turn toward it and back."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.request import Look
from mapctl.features import PRIOR_FPS
from mapctl.kinematics.head_turning import measure_look_angle, turn_head
from mapctl.motion import Motion

_EASE_SECONDS = 0.5  # in which the head turns there, and back


def turn_heads(motion: Motion, looks: Sequence[Look]) -> Motion:
    """Turn neck and head toward what is looked at, in half a second and back in another."""
    for look in looks:
        motion = turn_head(motion, _place(look), _ease(motion.num_frames, look))
    return motion


def measure_look_errors(motion: Motion, look: Look) -> Float[Tensor, " frames"]:
    """Measure the angle between where the head faces and what it is to look at, degrees, while it is to look."""
    first = round(look.seconds * PRIOR_FPS)
    held = slice(first, first + round(look.hold_seconds * PRIOR_FPS) + 1)
    return torch.rad2deg(measure_look_angle(motion, _place(look)))[held]


def _place(look: Look) -> Float[Tensor, "1 3"]:
    return torch.tensor([look.place], dtype=torch.float64)


def _ease(frames: int, look: Look) -> Float[Tensor, " frames"]:
    """Return how far the head is turned in each frame, 0 to 1."""
    seconds = torch.arange(frames, dtype=torch.float64) / PRIOR_FPS
    before = (look.seconds - seconds).clamp_min(0) + (seconds - look.seconds - look.hold_seconds).clamp_min(0)
    share = (1 - before / _EASE_SECONDS).clamp_min(0)
    return share * share * (3 - 2 * share)
