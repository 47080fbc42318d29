"""Forward kinematics and heading: pure functions, differentiable, any batch shape."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
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
    positions, world = [root_position], [local_quat_xyzw[..., 0, :]]
    for joint in range(1, len(parents)):
        parent = parents[joint]
        offset = offsets[..., joint, :].expand_as(root_position)
        positions.append(positions[parent] + rotations.rotate(world[parent], offset))
        world.append(rotations.multiply(world[parent], local_quat_xyzw[..., joint, :]))
    return torch.stack(positions, dim=-2), torch.stack(world, dim=-2)


def local_from_world(
    parents: Sequence[int], world_quat_xyzw: Float[Tensor, "*batch joints 4"]
) -> Float[Tensor, "*batch joints 4"]:
    """Return rotations of every joint in its parent's frame, from world rotations."""
    local = [world_quat_xyzw[..., 0, :]]
    for joint in range(1, len(parents)):
        parent = world_quat_xyzw[..., parents[joint], :]
        local.append(rotations.multiply(rotations.inverse(parent), world_quat_xyzw[..., joint, :]))
    return torch.stack(local, dim=-2)


def heading(hips_world_quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Return the facing angle about +Y in radians: 0 along +Z, +pi/2 along +X (canonical joint frames)."""
    return rotations.split_heading(hips_world_quat_xyzw)[0]


def positions_from_matrices(
    skeleton: Skeleton, local_matrix: Float[Tensor, "*batch joints 3 3"]
) -> Float[Tensor, "*batch joints 3"]:
    """Return the joint positions (metres) relative to the root at the origin, from local rotation matrices.

    All joints of one depth are multiplied at once: a window of frames then takes a dozen tensor operations.
    """
    offsets = skeleton.offsets.to(local_matrix.dtype)
    order, world, positions = [0], local_matrix[..., :1, :, :], torch.zeros_like(local_matrix[..., :1, :, 0])
    above_world, above_positions, above = world, positions, [0]
    collected = [positions]
    while level := [j for j, parent in enumerate(skeleton.parents) if parent in above]:
        rows = [above.index(skeleton.parents[j]) for j in level]
        parent_world = above_world[..., rows, :, :]
        above_positions = above_positions[..., rows, :] + (parent_world @ offsets[level].unsqueeze(-1)).squeeze(-1)
        above_world = parent_world @ local_matrix[..., level, :, :]
        collected.append(above_positions)
        order, above = order + level, level
    inverse = torch.argsort(torch.tensor(order))
    return torch.cat(collected, dim=-2)[..., inverse, :]
