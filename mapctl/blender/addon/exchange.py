"""Motions in mapctl's .npz files (docs/guides/formats.md), and rotations, with numpy alone.

The add-on runs in Blender's own Python and cannot import mapctl.
"""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from .process import AddonError


def to_matrices(quat_xyzw: np.ndarray) -> np.ndarray:
    """Convert unit quaternions (..., 4), the real part last, to rotation matrices (..., 3, 3)."""
    x, y, z, w = np.moveaxis(quat_xyzw, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_quaternions(matrices: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to unit quaternions (..., 4), the real part last and not negative.

    Of the four squares the largest is taken, so that no division is by a small number (Shepperd, 1978).
    """
    m = np.moveaxis(matrices, (-2, -1), (0, 1))
    outer = np.empty((*matrices.shape[:-2], 4, 4))  # four times the products of x, y, z, w
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[..., i, i] = 1 + m[i, i] - m[j, j] - m[k, k]
        outer[..., i, j] = outer[..., j, i] = m[i, j] + m[j, i]
        outer[..., i, 3] = outer[..., 3, i] = m[k, j] - m[j, k]
    outer[..., 3, 3] = 1 + m[0, 0] + m[1, 1] + m[2, 2]
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    rows = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    rows = rows / np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.where(rows[..., 3:] < 0, -rows, rows)


def orthonormalise(matrices: np.ndarray) -> np.ndarray:
    """Take the nearest rotations (..., 3, 3) of matrices that may scale, stretch or mirror as well."""
    left, _, right = np.linalg.svd(matrices)
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right


def join_signs(quaternions: np.ndarray) -> np.ndarray:
    """Turn signs of quaternions (frames, 4) so that each is nearest to the one before it."""
    dots = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1])
    signs = np.cumprod(np.r_[1.0, np.where(dots < 0, -1.0, 1.0)])
    return quaternions * signs[:, None]


def transpose(matrices: np.ndarray) -> np.ndarray:
    """Exchange the last two axes: the inverses of rotations."""
    return np.swapaxes(matrices, -1, -2)


FORMAT = "mapctl-motion-1"
"""Name and version of the set of keys."""
_RIGID = 1e-4  # metres: what travels less within its parent is a rigid bone, and Blender's rounding


@dataclass(frozen=True, eq=False)
class WorldMotion:
    """Joints in mapctl's world: metres, Y up. A joint's rotation is relative to the rest pose."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for joint 0."""
    rest: np.ndarray
    """Joints in the rest pose, (joints, 3)."""
    fps: Fraction
    rotations: np.ndarray
    """Rotation matrices from the rest pose, in the world, (frames, joints, 3, 3)."""
    positions: np.ndarray
    """Joints, (frames, joints, 3)."""


def write(motion: WorldMotion, path: Path, ends: dict[str, np.ndarray], movable: frozenset[int]) -> None:
    """Write a motion. `ends` are End Sites at rest, in the world, by joint; bones of `movable` joints may stretch."""
    parents = np.array(motion.parents)
    up = np.maximum(parents, 0)
    offsets = np.where(parents[:, None] < 0, 0.0, motion.rest - motion.rest[up])
    turned_back = transpose(motion.rotations[:, up])
    local = np.where(parents[:, None, None] < 0, motion.rotations, turned_back @ motion.rotations)
    apart = np.einsum("fjab,fjb->fja", turned_back, motion.positions - motion.positions[:, up])
    stretched = np.abs(apart - offsets).max(axis=(0, 2)) > _RIGID
    moving = [joint for joint in range(1, len(parents)) if joint in movable and stretched[joint]]
    end_offsets = [end - motion.rest[motion.names.index(name)] for name, end in ends.items()]
    np.savez(
        path,
        format=np.array(FORMAT),
        names=np.array(motion.names),
        parents=parents.astype(np.int64),
        offsets=offsets,
        end_names=np.array(list(ends), dtype=np.str_),
        end_offsets=np.array(end_offsets, dtype=np.float64).reshape(-1, 3),
        fps=np.array([motion.fps.numerator, motion.fps.denominator], dtype=np.int64),
        root_position_world=motion.positions[:, 0],
        local_quat_xyzw=to_quaternions(local),
        moving_joints=np.array(moving, dtype=np.int64),
        moving_offsets=np.moveaxis(apart[:, moving], 1, 0),
    )


def read(path: Path) -> tuple[WorldMotion, frozenset[int]]:
    """Read a motion, and which of its joints travel within their parent; AddonError for another format."""
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    if str(arrays["format"]) != FORMAT:
        raise AddonError(f"mapctl wrote the format {arrays['format']}, this add-on reads {FORMAT}: update the add-on")
    parents, local = arrays["parents"].tolist(), to_matrices(arrays["local_quat_xyzw"])
    tracks = dict(zip(arrays["moving_joints"].tolist(), arrays["moving_offsets"], strict=True))
    rest, rotations = np.zeros_like(arrays["offsets"]), local.copy()
    positions = np.repeat(arrays["root_position_world"][:, None], len(parents), axis=1)
    for joint, parent in enumerate(parents[1:], start=1):
        rest[joint] = rest[parent] + arrays["offsets"][joint]
        rotations[:, joint] = rotations[:, parent] @ local[:, joint]
        offset = tracks.get(joint, arrays["offsets"][joint])
        positions[:, joint] = positions[:, parent] + (rotations[:, parent] @ offset[..., None])[..., 0]
    fps = Fraction(*arrays["fps"].tolist())
    names = tuple(arrays["names"].tolist())
    return WorldMotion(names, tuple(parents), rest, fps, rotations, positions), frozenset(tracks)
