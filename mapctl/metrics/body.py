"""Measures of the whole body: jitter, speed, facing, height and variety of poses."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.numerics.gaussian import low_pass
from mapctl.rotations import unwrap_angle

TURN_SECONDS = 0.35
"""Standard deviation of the Gaussian that takes each stride's swing of the hips out of the turn rate."""


def jitter(positions: Float[Tensor, "frames joints 3"], fps: float) -> float:
    """Return the mean size of the jerk over frames and joints, m/s^3; NaN for fewer than 4 frames."""
    return float(positions.diff(n=3, dim=0).norm(dim=-1).mean() * fps**3)


def ground_speed(hips: Float[Tensor, "frames 3"], fps: float) -> float:
    """Return the mean speed over the ground, m/s."""
    return float(hips[:, ::2].diff(dim=0).norm(dim=-1).mean() * fps)


def facing(left_leg: Float[Tensor, "frames 3"], right_leg: Float[Tensor, "frames 3"]) -> Float[Tensor, "frames"]:
    """Return the facing angle, radians, unwrapped, square to the line between the upper legs: 0 is +Z, pi/2 is +X."""
    across = left_leg - right_leg
    return unwrap_angle(torch.atan2(-across[:, 2], across[:, 0]))


def turn_rate(angle: Float[Tensor, "frames"], fps: float) -> float:
    """Return the mean size of the turn rate after strides are smoothed away, rad/s; NaN for one frame."""
    return float(low_pass(angle, seconds=TURN_SECONDS, fps=fps).diff().abs().mean() * fps)


def pose_variation(
    positions: Float[Tensor, "frames joints 3"], hips: Float[Tensor, "frames 3"], angle: Float[Tensor, "frames"]
) -> float:
    """Return the spread of the poses, metres; a frozen pose has none however it travels and turns.

    The standard deviation over frames of each coordinate of each joint, seen from the hips and turned to face +Z, and
    of these the mean.
    """
    relative = rotations.rotate_about_y(positions - hips[:, None], -angle[:, None])
    return float(relative.movedim(-1, 0).std(dim=1, correction=0).mean())
