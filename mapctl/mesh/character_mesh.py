"""A character's own triangles, that its joints carry: linear blend skinning in the rest pose's frames."""

from dataclasses import dataclass

import numpy as np

from mapctl.mesh.primitives import Array


@dataclass(frozen=True, eq=False)
class CharacterMesh:
    """Triangles of a character in its rest pose, in which every joint frame is aligned with the world."""

    vertices: Array
    """(n, 3) in the rest pose, metres."""
    normals: Array
    """(n, 3) unit, likewise."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    rgba: Array
    """(n, 4) sRGB colour and opacity, 0 to 1: the material's and its picture's at the vertex."""
    joints: Array
    """(n, k) indices of the joints that carry a vertex."""
    weights: Array
    """(n, k) their shares; each vertex's add up to 1."""
    rest: Array
    """(joints, 3) positions of all joints in the rest pose, metres."""

    def pose(self, positions: Array, turns: Array) -> tuple[Array, Array]:
        """Return vertices (n, 3) and unit normals (n, 3) of one pose.

        `positions` (joints, 3) are the joints' in the world, metres; `turns` (joints, 3, 3) their world rotations
        against the rest pose, as those of a `Motion` that was read from a character's file.
        """
        vertices, normals = np.zeros_like(self.vertices), np.zeros_like(self.normals)
        shifts = positions - np.einsum("jab,jb->ja", turns, self.rest)
        for joint, weight in zip(self.joints.T, self.weights.T, strict=True):
            turn = turns[joint]
            vertices += weight[:, None] * (np.einsum("nab,nb->na", turn, self.vertices) + shifts[joint])
            normals += weight[:, None] * np.einsum("nab,nb->na", turn, self.normals)
        return vertices, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def merge_meshes(meshes: list[CharacterMesh]) -> CharacterMesh:
    """Merge meshes of one skeleton, at least one, into one mesh."""
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    widest = max(mesh.joints.shape[1] for mesh in meshes)
    padded = [np.pad(table, ((0, 0), (0, widest - table.shape[1]))) for mesh in meshes for table in _carriers(mesh)]
    return CharacterMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, counts, strict=False)]),
        rgba=np.concatenate([mesh.rgba for mesh in meshes]),
        joints=np.concatenate(padded[::2]),
        weights=np.concatenate(padded[1::2]),
        rest=meshes[0].rest,
    )


def _carriers(mesh: CharacterMesh) -> tuple[Array, Array]:
    return mesh.joints, mesh.weights


def compute_normals(vertices: Array, faces: Array) -> Array:
    """Return unit normals (n, 3): those of the triangles around a vertex, weighted by area."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), np.array([0.0, 1.0, 0.0]))
