"""A character's own triangles, that its joints carry: linear blend skinning in the rest pose's frames."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from mapctl.mesh.primitives import Array


@dataclass(frozen=True, eq=False)
class CharacterMesh:
    """Triangles of a character in its rest pose, and the joints that carry them."""

    vertices: Array
    """(n, 3) in the rest pose, metres."""
    normals: Array
    """(n, 3) of length 1, one a vertex, in the rest pose."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    rgba: Array
    """(n, 4) sRGB colour and opacity, 0 to 1: the material's and its texture's at the vertex."""
    joints: Array
    """(n, k) indices of the joints that carry a vertex."""
    weights: Array
    """(n, k) their shares; each vertex's add up to 1."""
    rest: Array
    """(joints, 3) positions of all joints in the rest pose, metres."""
    frames: Array | None = None
    """(joints, 3, 3) rotations of all joints in the rest pose; None where all are aligned with the world."""

    def pose(self, positions: Array, turns: Array) -> tuple[Array, Array]:
        """Return vertices (n, 3) and unit normals (n, 3) of one pose.

        `positions` (joints, 3) are the joints' in the world, metres; `turns` (joints, 3, 3) their world
        rotations, as those of a `Motion` that was read from a character's file.
        """
        # In 32 bits, twice as fast, and still exact to a micrometre: for that the origin must be near the body.
        centre = positions[0]
        matrices = np.empty((len(turns), 3, 4), np.float32)
        turns = turns if self.frames is None else turns @ np.swapaxes(self.frames, 1, 2)
        matrices[..., :3] = turns
        matrices[..., 3] = positions - centre - np.einsum("jab,jb->ja", turns, self.rest)
        blended = (self._shares @ matrices.reshape(-1, 12)).reshape(-1, 3, 4)
        local, outward = self._local
        vertices = np.einsum("nab,nb->na", blended, local)
        normals = np.einsum("nab,nb->na", blended[..., :3], outward)
        lengths = np.sqrt(np.einsum("na,na->n", normals, normals))
        return vertices + centre, normals / np.maximum(lengths, 1e-12)[:, None]

    def to_joints(self, points: Array, joints: Array) -> Array:
        """Return points (n, 3) of the rest pose in the frames of joints (n,)."""
        local = points - self.rest[joints]
        return local if self.frames is None else np.einsum("nba,nb->na", self.frames[joints], local)

    @cached_property
    def _shares(self) -> "scipy.sparse.csr_array":
        """(n, joints) shares, for most of which are zero."""
        rows = np.repeat(np.arange(len(self.joints)), self.joints.shape[1])
        entries = (self.weights.reshape(-1).astype(np.float32), (rows, self.joints.reshape(-1)))
        return scipy.sparse.csr_array(entries, shape=(len(self.joints), len(self.rest)))

    @cached_property
    def _local(self) -> tuple[Array, Array]:
        """Vertices (n, 4) with a 1 behind them, and normals (n, 3)."""
        points = np.column_stack([self.vertices, np.ones(len(self.vertices))])
        return points.astype(np.float32), self.normals.astype(np.float32)


def merge_meshes(meshes: list[CharacterMesh]) -> CharacterMesh:
    """Merge meshes of one skeleton, at least one, into one mesh."""
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    widest = max(mesh.joints.shape[1] for mesh in meshes)
    padded = [
        np.pad(table, ((0, 0), (0, widest - table.shape[1])))
        for mesh in meshes
        for table in (mesh.joints, mesh.weights)
    ]
    return CharacterMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, counts, strict=False)]),
        rgba=np.concatenate([mesh.rgba for mesh in meshes]),
        joints=np.concatenate(padded[::2]),
        weights=np.concatenate(padded[1::2]),
        rest=meshes[0].rest,
    )


def compute_normals(vertices: Array, faces: Array) -> Array:
    """Return unit normals (n, 3): those of the triangles around a vertex, weighted by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), np.array([0.0, 1.0, 0.0]))
