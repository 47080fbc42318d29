"""Moving whole motions over the ground."""

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
