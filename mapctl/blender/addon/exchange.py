"""Motions in mapctl's .npz files (docs/guides/formats.md): written and read with numpy alone."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from .problem import AddonError
from .rotations import to_matrices, to_quaternions, transpose

FORMAT = "mapctl-motion-1"
"""Name and version of the set of keys."""
_RIGID = 1e-4  # metres: what travels less within its parent is a rigid bone, and Blender's rounding


@dataclass(frozen=True, eq=False)
class WorldMotion:
    """Joints in mapctl's world: metres, Y up. A joint's rotation is relative to the rest pose."""

    names: tuple[str, ...]
    """Joint names."""
    parents: tuple[int, ...]
    """Index of each joint's parent; -1 for joint 0."""
    rest: np.ndarray
    """Joints in the rest pose, (joints, 3)."""
    fps: Fraction
    """Frames per second."""
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
    end_offsets = [place - motion.rest[motion.names.index(name)] for name, place in ends.items()]
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
