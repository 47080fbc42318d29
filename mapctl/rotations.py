"""Rotations of batches, differentiable: quaternions (xyzw), matrices, rotation vectors, Euler angles; radians.

First derivatives are exact at the identity and near pi, where sin(x) / x and its inverse are taken from their series.
"""

import math
from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

Angle = TypeVar("Angle", float, np.ndarray, Tensor)
_TINY_ANGLE = 1e-6


def multiply(
    first_xyzw: Float[Tensor, "*#batch 4"], second_xyzw: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Return the product of quaternions: the second rotation, then the first."""
    p, q = torch.broadcast_tensors(first_xyzw, second_xyzw)
    p_vector, q_vector, p_real, q_real = p[..., :3], q[..., :3], p[..., 3], q[..., 3]
    vector = p_real[..., None] * q_vector + q_real[..., None] * p_vector + torch.cross(p_vector, q_vector, dim=-1)
    real = p_real * q_real - (p_vector * q_vector).sum(dim=-1)
    return torch.cat((vector, real[..., None]), dim=-1)


def inverse(quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Return the inverse of unit quaternions, their conjugate."""
    conjugate = quat_xyzw.clone()
    conjugate[..., :3] *= -1
    return conjugate


def rotate(quat_xyzw: Float[Tensor, "*#batch 4"], vector: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors by quaternions of any length but zero."""
    axis, vector = torch.broadcast_tensors(quat_xyzw[..., :3], vector)
    across = torch.cross(axis, vector, dim=-1)
    turned = quat_xyzw[..., 3:] * across + torch.cross(axis, across, dim=-1)
    return vector + 2 * turned / quat_xyzw.square().sum(dim=-1, keepdim=True)


def from_rotation_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the quaternions of rotation vectors."""
    flat = vector.reshape(-1, 3)
    angle = flat.norm(dim=-1)
    half = angle / 2
    small = half < _small_angle(half)
    ratio = torch.where(small, 1 - half**2 / 6 + half**4 / 120, torch.sin(half) / torch.where(small, 1.0, half))
    quat = torch.cat(((ratio / 2.0)[:, None] * flat, torch.cos(angle / 2)[:, None]), dim=-1)
    return quat.reshape(*vector.shape[:-1], 4)


def to_rotation_vector(quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Return the shortest rotation vectors, whatever the signs of the unit quaternions."""
    sign = (quat_xyzw[..., 3:] > 0).to(quat_xyzw.dtype) * 2.0 - 1.0
    return to_long_rotation_vector(quat_xyzw * sign)


def to_long_rotation_vector(quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Return rotation vectors, longer than pi where the real part of a unit quaternion is negative; undefined for a
    real part of -1."""
    flat = quat_xyzw.reshape(-1, 4)
    half = torch.atan2(flat[:, :3].norm(dim=1), flat[:, 3])
    small = half.abs() < _small_angle(half)
    ratio = torch.where(small, 1 + half**2 / 6 + 7 * half**4 / 360, half / torch.where(small, 1.0, torch.sin(half)))
    return ((2.0 * ratio)[:, None] * flat[:, :3]).reshape(*quat_xyzw.shape[:-1], 3)


def _small_angle(angle: Tensor) -> float:
    """Return the angle below which the series of sin(x) / x has a better derivative than the quotient: the
    series leaves out terms in x^4, the quotient loses eps / x^2 by cancellation."""
    return 2.0 * torch.finfo(angle.dtype).eps ** (1 / 6)


def to_matrix(quat_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the matrices of unit quaternions."""
    x, y, z, w = quat_xyzw.unbind(dim=-1)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, zw, xz, yw, yz, xw = x * y, z * w, x * z, y * w, y * z, x * w
    first = (xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw))
    second = (2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw))
    third = (2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww)
    return torch.stack((*first, *second, *third), dim=-1).reshape(*quat_xyzw.shape[:-1], 3, 3)


def from_matrix(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the unit quaternions of rotation matrices: of four multiples of it, each by one of its components, that by
    the largest (Markley 2008)."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    by_x = (1 + a - e - i, d + b, g + c, h - f)
    by_y = (b + d, 1 + e - i - a, h + f, c - g)
    by_z = (c + g, f + h, 1 + i - a - e, d - b)
    by_w = (h - f, c - g, d - b, 1 + a + e + i)
    multiples = torch.stack((*by_x, *by_y, *by_z, *by_w), dim=-1).unflatten(-1, (4, 4))
    largest = multiples.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    chosen = torch.gather(multiples, -2, largest[..., None, None].expand(*largest.shape, 1, 4))[..., 0, :]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def rotation_vector_to_matrix(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the matrices of rotation vectors, by Rodrigues' formula, or to first order where the angle is tiny."""
    flat = vector.reshape(-1, 3)
    angle = flat.norm(dim=-1)
    x, y, z = (flat / angle[..., None].clamp_min(_TINY_ANGLE)).unbind(dim=-1)
    sine, rest = torch.sin(angle), 1 - torch.cos(angle)
    xs, ys, zs = x * sine, y * sine, z * sine
    xy, xz, yz = x * y * rest, x * z * rest, y * z * rest
    xx, yy, zz = x**2 * rest, y**2 * rest, z**2 * rest
    whole = (1 - yy - zz, xy - zs, xz + ys, xy + zs, 1 - xx - zz, yz - xs, xz - ys, yz + xs, 1 - xx - yy)
    (x, y, z), one = flat.unbind(dim=-1), torch.ones_like(angle)
    first_order = (one, -z, y, z, one, -x, -y, x, one)
    found = torch.where((angle < _TINY_ANGLE)[:, None], torch.stack(first_order, -1), torch.stack(whole, -1))
    return found.reshape(*vector.shape[:-1], 3, 3)


def about_y(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 4"]:
    """Return the quaternion (xyzw) of a turn by `angle` radians about +Y; positive turns +Z toward +X."""
    zero = torch.zeros_like(angle)
    return torch.stack([zero, torch.sin(angle / 2), zero, torch.cos(angle / 2)], dim=-1)


def split_heading(quat_xyzw: Float[Tensor, "*batch 4"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 4"]]:
    """Split a rotation about Y: (heading, tilt) with `quat = about_y(heading) * tilt` and no rotation about Y left in
    `tilt`.

    The tilt's rotation vector has a zero y component, so two numbers hold it. Undefined only upside down.
    """
    heading = 2 * torch.atan2(quat_xyzw[..., 1], quat_xyzw[..., 3])
    heading = wrap_angle(heading)
    return heading, multiply(about_y(-heading), quat_xyzw)


def wrap_angle(angle: Angle) -> Angle:
    """Wrap an angle, or each of many, to [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def unwrap_angle(angle: Float[Tensor, "*batch frames"]) -> Float[Tensor, "*batch frames"]:
    """Unwrap angles along the last axis: no jumps of 2 pi."""
    steps = wrap_angle(torch.diff(angle, dim=-1))
    return torch.cat([angle[..., :1], angle[..., :1] + torch.cumsum(steps, dim=-1)], dim=-1)


def rotate_ground(vector_xz: Float[Tensor, "*#batch 2"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 2"]:
    """Rotate ground vectors (x, z) by `angle` radians about +Y; one angle may rotate several vectors."""
    x, z = vector_xz.unbind(-1)
    sine, cosine = torch.sin(angle), torch.cos(angle)
    return torch.stack([cosine * x + sine * z, cosine * z - sine * x], dim=-1)


def lift_ground(ground_xz: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Return ground vectors (x, z) as (x, 0, z)."""
    return torch.stack([ground_xz[..., 0], torch.zeros_like(ground_xz[..., 0]), ground_xz[..., 1]], dim=-1)


def rotate_about_y(vector: Float[Tensor, "*#batch 3"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 3"]:
    """Rotate vectors by `angle` radians about +Y; one angle may rotate several vectors."""
    ground = rotate_ground(vector[..., ::2], angle)
    return torch.stack([ground[..., 0], vector[..., 1], ground[..., 1]], dim=-1)


def between_vectors(start: Float[Tensor, "*batch 3"], stop: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the shortest rotation (xyzw) from one direction to the other; none where one of them has no length."""
    start, stop = (torch.nn.functional.normalize(vector, dim=-1) for vector in (start, stop))
    cosine = (start * stop).sum(-1, keepdim=True)
    axis = torch.linalg.cross(start, stop)
    # Half a turn has no shortest arc: any axis across will do.
    across = torch.linalg.cross(start, start.abs().argmin(dim=-1, keepdim=True).eq(torch.arange(3)).to(start))
    opposite = (cosine < 0) & (axis.norm(dim=-1, keepdim=True) < 1e-9)
    real = torch.where(cosine < -0.99, (start + stop).square().sum(-1, keepdim=True) / 2, 1 + cosine)  # exact near it
    quat = torch.cat([torch.where(opposite, across, axis), torch.where(opposite, 0.0, real)], dim=-1)
    still = (start.norm(dim=-1, keepdim=True) < 0.5) | (stop.norm(dim=-1, keepdim=True) < 0.5)
    none = quat.new_tensor([0.0, 0.0, 0.0, 1.0]).expand_as(quat)
    return torch.nn.functional.normalize(torch.where(still, none, quat), dim=-1)


def to_six(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 6"]:
    """Return the first two columns of rotation matrices: six numbers that are continuous over all rotations (Zhou et
    al. 2019)."""
    return matrix[..., :2].transpose(-1, -2).flatten(-2)


def from_six(six: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrices whose first two columns are nearest, by Gram and Schmidt (Zhou et al. 2019)."""
    first = torch.nn.functional.normalize(six[..., :3], dim=-1)
    second = six[..., 3:] - (first * six[..., 3:]).sum(dim=-1, keepdim=True) * first
    second = torch.nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def euler_axes(orders: Sequence[str]) -> Int[Tensor, "joints 3"]:
    """Return the axes (0, 1, 2 for X, Y, Z) of orders of Euler angles such as `XYZ`, for `from_euler`; ValueError
    unless each names the three axes once."""
    if wrong := [order for order in orders if sorted(order) != ["X", "Y", "Z"]]:
        raise ValueError(f"an order of Tait-Bryan angles names X, Y and Z once, got {wrong[0]!r}")
    return torch.tensor([["XYZ".index(letter) for letter in order] for order in orders])


def from_euler(angles: Float[Tensor, "*#batch 3"], axes: Int[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation matrices of intrinsic Tait-Bryan angles, radians: the product of the turns about the axes in
    their order. Each joint of a batch may have axes of its own."""
    i, j, _ = axes.unbind(dim=-1)
    # A left-handed order is the mirror image of a right-handed one, in which all turns go the other way.
    sines = torch.sin(angles) * _handedness(i, j)[..., None]
    (sa, sb, sc), (ca, cb, cc) = sines.unbind(dim=-1), torch.cos(angles).unbind(dim=-1)
    sa_sb, ca_sb = sa * sb, ca * sb
    row_i = (cb * cc, -cb * sc, sb)
    row_j = (sa_sb * cc + ca * sc, ca * cc - sa_sb * sc, -sa * cb)
    row_k = (sa * sc - ca_sb * cc, ca_sb * sc + sa * cc, ca * cb)
    along_order = torch.stack([*row_i, *row_j, *row_k], dim=-1)
    rank = axes.argsort(dim=-1)
    flat, at = torch.broadcast_tensors(along_order, (3 * rank[..., :, None] + rank[..., None, :]).flatten(-2))
    return flat.gather(-1, at).unflatten(-1, (3, 3))


def to_euler(matrix: Float[Tensor, "*#batch 3 3"], axes: Int[Tensor, "*#batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the intrinsic Tait-Bryan angles of rotation matrices, radians: the middle one from -pi/2 to pi/2, the
    others from -pi to pi. Differentiable but for the middle one's ends, where the others are undefined."""
    i, j, k = axes.unbind(dim=-1)
    sign = _handedness(i, j)

    def pick(row: Tensor, column: Tensor) -> Tensor:
        flat, at = torch.broadcast_tensors(matrix.flatten(-2), (3 * row + column)[..., None])
        return flat.gather(-1, at)[..., 0]

    sine, first_y, first_x = sign * pick(i, k), -sign * pick(j, k), pick(k, k)
    last_y, last_x = -sign * pick(i, j), pick(i, i)
    middle = torch.atan2(sine, torch.hypot(first_y, first_x))
    return torch.stack([torch.atan2(first_y, first_x), middle, torch.atan2(last_y, last_x)], dim=-1)


def _handedness(first: Int[Tensor, "*batch"], second: Int[Tensor, "*batch"]) -> Int[Tensor, "*batch"]:
    """Return 1 where the third axis is the first times the second, else -1."""
    return torch.where((second - first) % 3 == 1, 1, -1)


def turns_between(
    start_xyzw: Float[Tensor, "*#batch 4"], stop_xyzw: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 3"]:
    """Return the shortest rotation vectors from rotations to others, in the frames of the first."""
    return to_rotation_vector(multiply(inverse(start_xyzw), stop_xyzw))


def make_sign_continuous(quat_xyzw: Float[Tensor, "frames *joints 4"]) -> Float[Tensor, "frames *joints 4"]:
    """Choose signs of the same rotations so that neighbouring frames lie in one half of the sphere."""
    dots = (quat_xyzw[1:] * quat_xyzw[:-1]).sum(-1)
    signs = torch.cumprod(torch.where(dots < 0, -1.0, 1.0).to(quat_xyzw.dtype), dim=0)
    return torch.cat([quat_xyzw[:1], quat_xyzw[1:] * signs.unsqueeze(-1)])


def average(
    quat_xyzw: Float[Tensor, "count *joints 4"], weights: Float[Tensor, " count"] | None = None
) -> Float[Tensor, "*joints 4"]:
    """Return the mean rotation over the first axis, whatever the signs, with w >= 0: the first eigenvector of the
    quaternions' second moment, weighted or not (Markley et al. 2007).
    """
    weights = quat_xyzw.new_ones(len(quat_xyzw)) if weights is None else weights
    moment = torch.einsum("n,n...i,n...j->...ij", weights / weights.sum(), quat_xyzw, quat_xyzw)
    mean = torch.linalg.eigh(moment)[1][..., -1]
    return torch.where(mean[..., 3:] < 0, -mean, mean)


def slerp(
    start_xyzw: Float[Tensor, "*batch 4"], stop_xyzw: Float[Tensor, "*batch 4"], weight: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 4"]:
    """Interpolate spherically along the shortest arc; weight 0 gives the start."""
    aligned = torch.where((start_xyzw * stop_xyzw).sum(-1, keepdim=True) < 0, -stop_xyzw, stop_xyzw)
    step = turns_between(start_xyzw, aligned)
    return multiply(start_xyzw, from_rotation_vector(step * weight.unsqueeze(-1)))
