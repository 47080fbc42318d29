"""Rotation maths, once for the whole project; quaternions are xyzw, angles radians.

Built on roma, whose first derivatives are exact at the identity and near pi. What roma lacks and a character needs
is here: the split of a rotation into a turn about the vertical and what remains.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.numerics.light_roma import roma

multiply = roma.quat_product
inverse = roma.quat_conjugation
rotate = roma.quat_action
from_rotation_vector = roma.rotvec_to_unitquat
to_rotation_vector = roma.unitquat_to_rotvec  # the short one, whatever the quaternion's sign
to_long_rotation_vector = partial(roma.unitquat_to_rotvec, shortest_arc=False)  # as the quaternion's sign says
to_matrix = roma.unitquat_to_rotmat
from_matrix = roma.rotmat_to_unitquat
rotation_vector_to_matrix = roma.rotvec_to_rotmat


def about_y(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 4"]:
    """Quaternion (xyzw) of a turn by `angle` radians about +Y; positive turns +Z toward +X."""
    zero = torch.zeros_like(angle)
    return torch.stack([zero, torch.sin(angle / 2), zero, torch.cos(angle / 2)], dim=-1)


def split_heading(quat_xyzw: Float[Tensor, "*batch 4"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 4"]]:
    """Swing-twist about Y: (heading, tilt) with `quat = about_y(heading) * tilt` and no turn about Y left in `tilt`.

    The tilt's rotation vector has a zero y component, so two numbers hold it. Undefined only upside down.
    """
    heading = 2 * torch.atan2(quat_xyzw[..., 1], quat_xyzw[..., 3])
    heading = wrap_angle(heading)
    return heading, multiply(about_y(-heading), quat_xyzw)


def wrap_angle(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same angle in [-pi, pi)."""
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def unwrap_angle(angle: Float[Tensor, "*batch frames"]) -> Float[Tensor, "*batch frames"]:
    """Angles along the last axis without jumps of 2 pi."""
    steps = wrap_angle(torch.diff(angle, dim=-1))
    return torch.cat([angle[..., :1], angle[..., :1] + torch.cumsum(steps, dim=-1)], dim=-1)


def rotate_ground(vector_xz: Float[Tensor, "*#batch 2"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 2"]:
    """Ground-plane (x, z) vectors turned by `angle` radians about +Y; one angle may turn several vectors."""
    x, z = vector_xz.unbind(-1)
    sine, cosine = torch.sin(angle), torch.cos(angle)
    return torch.stack([cosine * x + sine * z, cosine * z - sine * x], dim=-1)


def make_sign_continuous(quat_xyzw: Float[Tensor, "frames *joints 4"]) -> Float[Tensor, "frames *joints 4"]:
    """The same rotations with signs chosen so that neighbouring frames lie in one half of the sphere."""
    dots = (quat_xyzw[1:] * quat_xyzw[:-1]).sum(-1)
    signs = torch.cumprod(torch.where(dots < 0, -1.0, 1.0).to(quat_xyzw.dtype), dim=0)
    return torch.cat([quat_xyzw[:1], quat_xyzw[1:] * signs.unsqueeze(-1)])


def slerp(
    start_xyzw: Float[Tensor, "*batch 4"], stop_xyzw: Float[Tensor, "*batch 4"], weight: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 4"]:
    """Shortest-arc spherical interpolation; weight 0 gives the start."""
    aligned = torch.where((start_xyzw * stop_xyzw).sum(-1, keepdim=True) < 0, -stop_xyzw, stop_xyzw)
    step = to_rotation_vector(multiply(inverse(start_xyzw), aligned))
    return multiply(start_xyzw, from_rotation_vector(step * weight.unsqueeze(-1)))
