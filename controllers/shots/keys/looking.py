"""Heads that look at something: neck and head turn toward it, as far as necks turn, and back."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.request import Look
from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

_EASE_SECONDS = 0.5  # in which the head turns there, and back
_NECK, _HEAD = CANONICAL.indices(("neck", "head"))
_TURNS = ((_NECK, 0.45, math.radians(40.0)), (_HEAD, 1.0, math.radians(55.0)))
"""Joints that turn, one after the other: the share of what is then left, and the most that each turns."""
_FORWARD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def turn_heads(motion: Motion, looks: Sequence[Look]) -> Motion:
    """Turn neck and head toward what is looked at, by 95 degrees at most, in half a second and back in another."""
    for look in looks:
        weight = _ease(motion.num_frames, look)
        for joint, share, most in _TURNS:
            turn = _find_turn(motion, look)
            angle = turn.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            turn = turn * (share * weight[:, None] * angle).clamp(max=most) / angle
            quats = motion.local_quat_xyzw.clone()
            above = motion.joint_rotations()[:, CANONICAL.parents[joint]]
            world = rotations.multiply(rotations.from_rotation_vector(turn), motion.joint_rotations()[:, joint])
            quats[:, joint] = rotations.multiply(rotations.inverse(above), world)
            motion = replace(motion, local_quat_xyzw=quats)
    return motion


def measure_look_errors(motion: Motion, look: Look) -> Float[Tensor, " frames"]:
    """Measure the angle between where the head faces and what it is to look at, degrees, while it is to look."""
    first = round(look.seconds * PRIOR_FPS)
    held = slice(first, first + round(look.hold_seconds * PRIOR_FPS) + 1)
    return torch.rad2deg(_find_turn(motion, look).norm(dim=-1))[held]


def _find_turn(motion: Motion, look: Look) -> Float[Tensor, "frames 3"]:
    """Find the rotation vectors in the world that turn the head toward its target."""
    facing = rotations.rotate(motion.joint_rotations()[:, _HEAD], _FORWARD.expand(motion.num_frames, 3))
    wanted = facing.new_tensor(look.place) - motion.joint_positions()[:, _HEAD]
    return rotations.to_rotation_vector(rotations.between_vectors(facing, wanted))


def _ease(frames: int, look: Look) -> Float[Tensor, " frames"]:
    """Return how far the head is turned in each frame, 0 to 1."""
    seconds = torch.arange(frames, dtype=torch.float64) / PRIOR_FPS
    before = (look.seconds - seconds).clamp_min(0) + (seconds - look.seconds - look.hold_seconds).clamp_min(0)
    share = (1 - before / _EASE_SECONDS).clamp_min(0)
    return share * share * (3 - 2 * share)
