"""Measures of the whole body: jitter and worst frames.

Worst frames (the fastest hand, the largest acceleration, the longest travel without support) are reported beside
means, which hide them: a hand that jumps by half a metre in one frame of two hundred hardly moves the mean.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import contacts, rotations
from mapctl.kinematics import heading_of_matrix
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import true_intervals
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
    return float(gaussian.average(angle, seconds=TURN_SECONDS, fps=fps).diff().abs().mean() * fps)


def measure_glide(feet: Float[Tensor, "frames 4 3"], fps: float) -> float:
    """Measure the longest travel without a step, metres: over the ground, of the slowest of toes and ankles (in this
    order), while all of them are faster than 20 cm/s and a toe is within 3 cm of its lowest height.
    """
    slowest = (feet[..., ::2].diff(dim=0).norm(dim=-1) * fps).amin(dim=1)
    toes = feet[:, :2, 1]
    gliding = (slowest > _GLIDE_SPEED) & ((toes - toes.amin(dim=0))[1:] < _GLIDE_HEIGHT).any(dim=1)
    travels = [float(slowest[start:stop].sum()) / fps for _, start, stop in true_intervals(gliding[:, None])]
    return max(travels, default=0.0)


def pose_variation(
    positions: Float[Tensor, "frames joints 3"], hips: Float[Tensor, "frames 3"], angle: Float[Tensor, "frames"]
) -> float:
    """Return the spread of the poses, metres; a frozen pose has none however it travels and turns.

    The standard deviation over frames of each coordinate of each joint, seen from the hips and turned to face +Z, and
    of these the mean.
    """
    relative = rotations.rotate_about_y(positions - hips[:, None], -angle[:, None])
    return float(relative.movedim(-1, 0).std(dim=1, correction=0).mean())


_GLIDE_SPEED, _GLIDE_HEIGHT = 0.2, 0.03  # m/s and metres
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


def measure_longest_unsupported(
    toes: Float[Tensor, "frames feet 3"], hips: Float[Tensor, "frames 3"], fps: float
) -> float:
    """Measure the longest time, seconds, for which the hips move over the ground while no toe is planted and the lower
    one is near its floor: the body slides, it does not fly. World positions in metres; the floor is each toe's own 5th
    percentile."""
    height = (toes[..., 1] - contacts.estimate_floor_heights(toes))[1:]
    speed, pace = (torch.diff(positions[..., ::2], dim=0).norm(dim=-1) * fps for positions in (toes, hips))
    planted = ((height < _LOW) & (speed < _SLOW)).any(dim=1)
    slides = ~planted & (height.amin(dim=1) < _NEAR_FLOOR) & (pace > _MOVING_SPEED)
    return max((stop - start for _, start, stop in true_intervals(slides[:, None])), default=0) / fps


_UNIT = 100.0  # cm


def measure_worst(
    positions: Float[Tensor, "frames joints 3"], hips: int, toes: Sequence[int], ankles: Sequence[int], fps: float
) -> dict[str, float]:
    """Measure the worst frames of a motion, which means hide: travel without a step, slide of a planted toe, time
    without support, depth of a toe under its floor, and the acceleration of any joint (0 for fewer than three frames).
    """
    feet, depth = positions[:, [*toes, *ankles]], contacts.estimate_floor_heights(positions[:, toes])
    ground, planted = positions[:, toes][..., ::2], contacts.detect_contacts(positions[:, toes], fps)
    slides = [ground[start:stop, foot] - ground[start, foot] for foot, start, stop in true_intervals(planted)]
    return {
        "glide_cm": _UNIT * measure_glide(feet, fps),
        "slide_max_cm": _UNIT * max((float(slide.norm(dim=-1).max()) for slide in slides), default=math.nan),
        "unsupported_max_s": measure_longest_unsupported(positions[:, toes], positions[:, hips], fps),
        "depth_max_cm": _UNIT * float((depth - positions[:, toes, 1]).max()),
        "acceleration_max_m_s2": float(measure_accelerations(positions, fps).amax()) if len(positions) > 2 else 0.0,
    }


def measure_accelerations(positions: Float[Tensor, "frames joints 3"], fps: float) -> Float[Tensor, " inner"]:
    """Measure the largest acceleration of any joint in each frame but the first and the last, m/s^2."""
    return positions.diff(n=2, dim=0).norm(dim=-1).amax(dim=1) * fps**2


def see_from_hips(
    positions: Float[Tensor, "*batch frames joints 3"], hips_world_matrix: Float[Tensor, "*batch frames 3 3"]
) -> Float[Tensor, "*batch frames joints 3"]:
    """Return joint positions from the hips along the hips' heading, metres."""
    return rotations.rotate_about_y(positions - positions[..., :1, :], -heading_of_matrix(hips_world_matrix)[..., None])


def measure_path_length(motion: Motion) -> float:
    """Measure the length of the joints' paths as seen from the hips, mean over joints, metres."""
    seen = see_from_hips(motion.joint_positions(), rotations.to_matrix(motion.local_quat_xyzw[:, 0]))
    return float(seen.diff(dim=0).norm(dim=-1).sum(dim=0).mean())
