"""Forward kinematics and heading: pure, differentiable, any batch shape."""

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.skeleton import Skeleton


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


def find_joints_above(parents: Sequence[int]) -> Bool[Tensor, "joints joints"]:
    """Find which joints (columns) are above each joint, or it itself."""
    table = torch.eye(len(parents), dtype=torch.bool)
    for joint, parent in enumerate(parents):
        if parent >= 0:
            table[joint] |= table[parent]
    return table


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
    ordered, matrices = torch.cat(positions, dim=1)[:, order], torch.cat(worlds, dim=2)[:, :, order]
    return ordered.movedim((0, 1), (-1, -2)), matrices.movedim((0, 1, 2), (-2, -1, -3))
