"""Moving whole motions over the ground, and turning heads: pure functions of motions."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.skeleton import CANONICAL


def rotate_world(motion: Motion, turn: Float[Tensor, "*frames 4"] | None) -> Motion:
    """Rotate a motion about the origin (xyzw), by one rotation or one of each frame; None for no rotation."""
    if turn is None:
        return motion
    every, local = turn.expand(motion.num_frames, 4), motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(every, local[:, 0])
    return replace(motion, root_position=rotations.rotate(every, motion.root_position), local_quat_xyzw=local)


def rotate_about_vertical(motion: Motion, angle: Float[Tensor, "*frames"] | float) -> Motion:
    """Rotate a motion about the vertical through the origin, radians; positive turns +Z toward +X."""
    return rotate_world(motion, rotations.about_y(torch.as_tensor(angle, dtype=motion.root_position.dtype)))


def move_to(motion: Motion, ground_xz: Float[Tensor, "2"], *, frame: int = 0) -> Motion:
    """Move a motion over the ground so that its root is at a position, x and z in metres, in one of its frames."""
    offset = rotations.lift_ground(ground_xz.to(motion.root_position) - motion.root_position[frame, ::2])
    return replace(motion, root_position=motion.root_position + offset)


def measure_travel(motion: Motion) -> tuple[float, float]:
    """Measure speed, m/s, and direction, radians from +Z toward +X, of a root from the first frame to the last."""
    x, z = (motion.root_position[-1, ::2] - motion.root_position[0, ::2]).tolist()
    return math.hypot(x, z) * float(motion.fps) / max(1, motion.num_frames - 1), math.atan2(x, z)


def bring_curve_points(
    points: Float[Tensor, "points dims"], pivot: Float[Tensor, " dims"], angle: float, ground_xz: Float[Tensor, "2"]
) -> Float[Tensor, "points dims"]:
    """Rotate points (x, z or x, y, z) about the vertical through a pivot, radians, and move that to a position."""
    ground = slice(0, None, points.shape[1] - 1)
    turn = points.new_tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    found = points.clone()
    found[:, ground] = (points[:, ground] - pivot[ground]) @ turn + ground_xz.to(points)
    return found


_NECK, _HEAD = CANONICAL.indices(("neck", "head"))
_TURNS = ((_NECK, 0.45, math.radians(40.0)), (_HEAD, 1.0, math.radians(55.0)))
"""Joints that turn, one after the other: the share of what is then left, and the most that each turns."""
_LOSING, _LOST = math.radians(115.0), math.radians(150.0)
"""Angles off the trunk's facing from which on a position is looked at less, and no more: a head that turned after what
goes past behind the back would whip from one shoulder to the other."""
_FORWARD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def turn_head(motion: Motion, positions: Float[Tensor, "#frames 3"], weight: Float[Tensor, " frames"]) -> Motion:
    """Turn neck and head toward positions in the world, metres, by a share `weight` (0 to 1) in each frame, and by 95
    degrees at most; what is behind is not looked at."""
    chest = CANONICAL.parents[_NECK]
    behind = _find_turn(motion, chest, positions).norm(dim=-1)
    weight = weight * smootherstep(((_LOST - behind) / (_LOST - _LOSING)).clamp(0, 1)).to(weight)
    for joint, share, most in _TURNS:
        turn = _find_turn(motion, _HEAD, positions)
        angle = turn.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        turn = turn * (share * weight[:, None] * angle).clamp(max=most) / angle
        quats = motion.local_quat_xyzw.clone()
        above = motion.joint_rotations()[:, CANONICAL.parents[joint]]
        world = rotations.multiply(rotations.from_rotation_vector(turn), motion.joint_rotations()[:, joint])
        quats[:, joint] = rotations.multiply(rotations.inverse(above), world)
        motion = replace(motion, local_quat_xyzw=quats)
    return motion


def measure_look_angle(motion: Motion, positions: Float[Tensor, "#frames 3"]) -> Float[Tensor, " frames"]:
    """Measure the angle between where the head faces and positions in the world, radians."""
    return _find_turn(motion, _HEAD, positions).norm(dim=-1)


def _find_turn(motion: Motion, joint: int, positions: Float[Tensor, "#frames 3"]) -> Float[Tensor, "frames 3"]:
    """Find the rotation vectors in the world that turn a joint's facing toward positions, as the head sees them."""
    facing = rotations.rotate(motion.joint_rotations()[:, joint], _FORWARD)
    wanted = positions.to(facing) - motion.joint_positions()[:, _HEAD]
    return rotations.to_rotation_vector(rotations.between_vectors(facing, wanted))
