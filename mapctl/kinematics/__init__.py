"""Forward kinematics, heading, and moving whole motions over the ground: pure, differentiable, any batch shape."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.skeleton import CANONICAL, Skeleton


def forward_kinematics(
    offsets: Float[Tensor, "*shape joints 3"],
    parents: Sequence[int],
    root_position: Float[Tensor, "*batch 3"],
    local_quat_xyzw: Float[Tensor, "*batch joints 4"],
) -> tuple[Float[Tensor, "*batch joints 3"], Float[Tensor, "*batch joints 4"]]:
    """Return the world positions (metres) and world rotations (xyzw) of every joint.

    `offsets` are the joints in their parents' frames; they may carry the batch's shape where bones are animated.
    Parents must precede their children.
    """
    offsets = offsets.expand(*root_position.shape[:-1], *offsets.shape[-2:])
    position, rotation = root_position[..., None, :], local_quat_xyzw[..., :1, :]
    levels, order = _group_by_depth(tuple(parents))
    positions, world = [position], [rotation]
    for joints, rows in levels:
        above = rotation[..., rows, :]
        position = position[..., rows, :] + rotations.rotate(above, offsets[..., joints, :])
        rotation = rotations.multiply(above, local_quat_xyzw[..., joints, :])
        positions.append(position)
        world.append(rotation)
    return torch.cat(positions, dim=-2)[..., order, :], torch.cat(world, dim=-2)[..., order, :]


@lru_cache(maxsize=256)
def _group_by_depth(parents: tuple[int, ...]) -> tuple[list[tuple[list[int], list[int]]], list[int]]:
    """Group joints below the root by depth: each level's joints, and their parents' rows in the level above; also
    returns where each joint stands in the levels one after another.

    All joints of one depth are then computed at once: a dozen tensor operations for a body instead of one a joint.
    """
    levels, above, standing = [], [0], [0]
    while joints := [joint for joint, parent in enumerate(parents) if joint and parent in above]:
        levels.append((joints, [above.index(parents[joint]) for joint in joints]))
        above, standing = joints, standing + joints
    return levels, sorted(range(len(parents)), key=standing.__getitem__)


def local_from_world(
    parents: Sequence[int], world_quat_xyzw: Float[Tensor, "*batch joints 4"]
) -> Float[Tensor, "*batch joints 4"]:
    """Return rotations of every joint in its parent's frame, from world rotations."""
    above = rotations.inverse(world_quat_xyzw[..., list(parents[1:]), :])
    return torch.cat([world_quat_xyzw[..., :1, :], rotations.multiply(above, world_quat_xyzw[..., 1:, :])], dim=-2)


def heading(hips_world_quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Return the facing angle about +Y in radians: 0 along +Z, +pi/2 along +X (canonical joint frames)."""
    return rotations.split_heading(hips_world_quat_xyzw)[0]


def heading_of_matrix(hips_world_matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Return the facing angle as `heading` does, radians, of rotation matrices; differentiable but upside down."""
    across = hips_world_matrix[..., 0, 2] - hips_world_matrix[..., 2, 0]
    trace = hips_world_matrix.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    return rotations.wrap_angle(2 * torch.atan2(across, 1 + trace))


def positions_from_matrices(
    skeleton: Skeleton, local_matrix: Float[Tensor, "*batch joints 3 3"]
) -> Float[Tensor, "*batch joints 3"]:
    """Return the joint positions (metres) relative to the root at the origin, from local rotation matrices."""
    return chain_matrices(skeleton.offsets.to(local_matrix), skeleton.parents, local_matrix)[0]


def chain_matrices(
    offsets: Float[Tensor, "*shape joints 3"], parents: Sequence[int], local_matrix: Float[Tensor, "*batch joints 3 3"]
) -> tuple[Float[Tensor, "*batch joints 3"], Float[Tensor, "*batch joints 3 3"]]:
    """Return the joint positions (metres) relative to the root at the origin, and the world rotation matrices.

    `offsets` are the joints in their parents' frames; they may carry a shape that broadcasts with the batch's.
    """
    levels, order = _group_by_depth(tuple(parents))
    # With the axes first a product of 3x3 matrices is a sum of three long vectors: twice as fast as that of small ones.
    turns = local_matrix.movedim((-2, -1, -3), (0, 1, 2)).contiguous()
    bones = offsets[(None,) * (local_matrix.ndim - 1 - offsets.ndim)].movedim((-1, -2), (0, 1))
    world, position = turns[:, :, :1], torch.zeros_like(turns[:, 0, :1])
    positions, worlds = [position], [world]
    for joints, rows in levels:
        above = world[:, :, rows]
        position = position[:, rows] + (above * bones[None, :, joints]).sum(dim=1)
        world = (above[:, :, None] * turns[None, :, :, joints]).sum(dim=1)
        positions.append(position)
        worlds.append(world)
    places, matrices = torch.cat(positions, dim=1)[:, order], torch.cat(worlds, dim=2)[:, :, order]
    return places.movedim((0, 1), (-1, -2)), matrices.movedim((0, 1, 2), (-2, -1, -3))


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


_NECK, _HEAD = CANONICAL.indices(("neck", "head"))
_TURNS = ((_NECK, 0.45, math.radians(40.0)), (_HEAD, 1.0, math.radians(55.0)))
"""Joints that turn, one after the other: the share of what is then left, and the most that each turns."""
_LOSING, _LOST = math.radians(115.0), math.radians(150.0)
"""Angles off the trunk's facing from which on a place is looked at less, and no more: who turned the head after what
goes past behind the back would whip it from one shoulder to the other."""
_FORWARD = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def turn_head(motion: Motion, places: Float[Tensor, "#frames 3"], weight: Float[Tensor, " frames"]) -> Motion:
    """Turn neck and head toward places in the world, metres, by a share `weight` (0 to 1) in each frame, and by 95
    degrees at most; what is behind is not looked at."""
    chest = CANONICAL.parents[_NECK]
    behind = _find_turn(motion, chest, places).norm(dim=-1)
    weight = weight * smootherstep(((_LOST - behind) / (_LOST - _LOSING)).clamp(0, 1)).to(weight)
    for joint, share, most in _TURNS:
        turn = _find_turn(motion, _HEAD, places)
        angle = turn.norm(dim=-1, keepdim=True).clamp_min(1e-9)
        turn = turn * (share * weight[:, None] * angle).clamp(max=most) / angle
        quats = motion.local_quat_xyzw.clone()
        above = motion.joint_rotations()[:, CANONICAL.parents[joint]]
        world = rotations.multiply(rotations.from_rotation_vector(turn), motion.joint_rotations()[:, joint])
        quats[:, joint] = rotations.multiply(rotations.inverse(above), world)
        motion = replace(motion, local_quat_xyzw=quats)
    return motion


def measure_look_angle(motion: Motion, places: Float[Tensor, "#frames 3"]) -> Float[Tensor, " frames"]:
    """Measure the angle between where the head faces and places in the world, radians."""
    return _find_turn(motion, _HEAD, places).norm(dim=-1)


def _find_turn(motion: Motion, joint: int, places: Float[Tensor, "#frames 3"]) -> Float[Tensor, "frames 3"]:
    """Find the rotation vectors in the world that turn a joint's facing toward places, as the head sees them."""
    facing = rotations.rotate(motion.joint_rotations()[:, joint], _FORWARD.expand(motion.num_frames, 3))
    wanted = places.to(facing) - motion.joint_positions()[:, _HEAD]
    return rotations.to_rotation_vector(rotations.between_vectors(facing, wanted))
