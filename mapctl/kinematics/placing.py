"""Moving whole motions over the ground, and how they travel there."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion


def rotate_about_vertical(motion: Motion, angle: Float[Tensor, "*frames"] | float) -> Motion:
    """Rotate a motion about the vertical through the origin, radians; positive turns +Z toward +X."""
    angle = torch.as_tensor(angle, dtype=motion.root_position.dtype)
    turn = rotations.about_y(angle).expand(motion.num_frames, 4)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    return replace(motion, local_quat_xyzw=quats, root_position=rotations.rotate(turn, motion.root_position))


def move_to(motion: Motion, ground_xz: Float[Tensor, "2"], *, frame: int = 0) -> Motion:
    """Move a motion over the ground so that its root is at a place, x and z in metres, in one of its frames."""
    offset = rotations.lift_ground(ground_xz.to(motion.root_position) - motion.root_position[frame, ::2])
    return replace(motion, root_position=motion.root_position + offset)


def measure_travel(motion: Motion) -> tuple[float, float]:
    """Measure speed, m/s, and direction, radians from +Z toward +X, of a root from the first frame to the last."""
    x, z = (motion.root_position[-1, ::2] - motion.root_position[0, ::2]).tolist()
    return math.hypot(x, z) * float(motion.fps) / max(1, motion.num_frames - 1), math.atan2(x, z)


def bring_curve_points(
    points: Float[Tensor, "points dims"], pivot: Float[Tensor, " dims"], angle: float, ground_xz: Float[Tensor, "2"]
) -> Float[Tensor, "points dims"]:
    """Rotate points (x, z or x, y, z) about the vertical through a pivot, radians, and move that to a place."""
    ground = slice(0, None, points.shape[1] - 1)
    turn = points.new_tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    found = points.clone()
    found[:, ground] = (points[:, ground] - pivot[ground]) @ turn + ground_xz.to(points)
    return found
