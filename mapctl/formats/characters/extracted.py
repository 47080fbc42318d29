"""Motions and meshes of the tables that `mapctl.isolated` takes from files."""

from collections.abc import Sequence
from fractions import Fraction
from os import PathLike

import numpy as np

from mapctl.errors import FileFormatError
from mapctl.formats.characters.rest_frames import RestFrames, chain_matrices, compose_matrices
from mapctl.formats.frame_rate import frame_rate
from mapctl.isolated.parts import MeshPart
from mapctl.mesh.character_mesh import CharacterMesh, compute_normals, merge_meshes

Array = np.ndarray
_FARTHEST = 1e6
_LARGEST = 1e12  # whatever the unit
_MAX_VERTICES = 2**23


def compose_transforms(path: str | PathLike[str], transforms: Array) -> Array:
    """Return matrices (..., 4, 4) of translation, rotation xyzw and scale (..., 10). FileFormatError where they are not
    finite, or larger than 1000 km."""
    if not np.isfinite(transforms).all() or np.abs(transforms).max(initial=0.0) > _FARTHEST:
        raise FileFormatError(path, "its animation holds numbers that are not finite, or larger than 1000 km")
    turns = transforms[..., 3:7]
    lengths = np.linalg.norm(turns, axis=-1, keepdims=True)
    if lengths.min(initial=1.0) < 1e-6:
        raise FileFormatError(path, "its animation holds a rotation of length zero")
    return compose_matrices(transforms[..., :3], turns / lengths, transforms[..., 7:])


def check_size(path: str | PathLike[str], worlds: Array) -> None:
    """Raise FileFormatError unless matrices (..., 4, 4) are finite and within 1000 km."""
    if not np.isfinite(worlds).all() or np.abs(worlds).max(initial=0.0) > _FARTHEST:
        raise FileFormatError(path, "its joints are at places that are not finite, or larger than 1000 km")


def place_joints(path: str | PathLike[str], parents: tuple[int, ...], local: Array, outer: Array) -> Array:
    """Return world matrices (..., joints, 4, 4) of local ones, as `chain_matrices`. FileFormatError where they are not
    finite, or larger than 1000 km."""
    with np.errstate(all="ignore"):
        worlds = chain_matrices(parents, local, outer)
    check_size(path, worlds)
    return worlds


def frame_rate_of(rate: float) -> Fraction:
    """Return the exact frame rate behind one that a file says as a floating-point number: 29.97 is 30000/1001."""
    near = frame_rate(f"{1.0 / rate:.6f}") if 0.01 < rate < 1e4 else Fraction(rate)
    return near if abs(float(near) / rate - 1.0) < 1e-5 else Fraction(rate).limit_denominator(10_000)


def build_mesh(
    path: str | PathLike[str], armature: str, parts: Sequence[MeshPart], frames: RestFrames
) -> CharacterMesh:
    """Build the mesh of all parts in the rest pose. FileFormatError where there is none, or it is broken."""
    found = [_build_part(path, part, frames) for part in parts if len(part.faces)]
    if not found:
        raise FileFormatError(path, f"armature {armature!r} carries no triangles")
    return merge_meshes(found)


def _build_part(path: str | PathLike[str], part: MeshPart, frames: RestFrames) -> CharacterMesh:
    count = len(part.points)
    if count > _MAX_VERTICES:
        raise FileFormatError(path, f"a mesh has {count} vertices, allowed are {_MAX_VERTICES}")
    for table in (part.points, part.matrices, part.rgba):
        if not np.isfinite(table).all() or np.abs(table).max(initial=0.0) > _LARGEST:
            raise FileFormatError(path, "its mesh holds numbers that are not finite, or too large")
    if part.faces.min() < 0 or part.faces.max() >= count:
        raise FileFormatError(path, f"a triangle names vertex {part.faces.max()} of {count}")
    if part.rows.min() < 0 or part.rows.max() >= len(part.joints):
        raise FileFormatError(path, f"a vertex names joint {part.rows.max()} of {len(part.joints)}")
    matrices = frames.matrices()[part.joints] @ part.matrices
    vertices = np.zeros((count, 3))
    for row, share in zip(part.rows.T, part.shares.T, strict=True):
        moved = np.einsum("nab,nb->na", matrices[row][:, :3, :3], part.points) + matrices[row][:, :3, 3]
        vertices += share[:, None] * moved
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > _FARTHEST:
        raise FileFormatError(path, "its mesh holds numbers that are not finite, or larger than 1000 km")
    normals = compute_normals(vertices, part.faces)
    rest = frames.positions
    return CharacterMesh(vertices, normals, part.faces, part.rgba, part.joints[part.rows], part.shares, rest)
