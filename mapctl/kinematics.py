"""Forward kinematics and heading: pure functions, differentiable, any batch shape."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations


def forward_kinematics(
    offsets: Float[Tensor, "*shape joints 3"],
    parents: Sequence[int],
    root_position: Float[Tensor, "*batch 3"],
    local_quat_xyzw: Float[Tensor, "*batch joints 4"],
) -> tuple[Float[Tensor, "*batch joints 3"], Float[Tensor, "*batch joints 4"]]:
    """World positions (metres) and world rotations (xyzw) of every joint.

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
    """Rotations of every joint in its parent's frame, from world rotations."""
    local = [world_quat_xyzw[..., 0, :]]
    for joint in range(1, len(parents)):
        parent = world_quat_xyzw[..., parents[joint], :]
        local.append(rotations.multiply(rotations.inverse(parent), world_quat_xyzw[..., joint, :]))
    return torch.stack(local, dim=-2)


def heading(hips_world_quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Facing angle about +Y in radians: 0 along +Z, +pi/2 along +X (canonical joint frames)."""
    return rotations.split_heading(hips_world_quat_xyzw)[0]
