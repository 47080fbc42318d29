"""A character's own triangles, that its joints carry: linear blend skinning in the rest pose's frames."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import scipy

from mapctl.mesh.primitives import Array

Paint = Callable[[Array, Array], Array]
"""Returns the colours (n, 4) at points of triangles: by the vertices at their corners and their shares, (n, 3)."""

MOST_CELLS = 60_000
"""Cells of one character."""
_SEEN = 0.06  # of a colour, 0 to 1, by which the vertices' must be wrong before triangles are parted
_CELL = 0.004  # metres of the finest cells
_COARSER = 1.25  # factor by which they grow until they are few enough
_MOST_PARTS = 8  # of an edge
_PROBE = 6  # parts of an edge at which a picture is looked at


@dataclass(frozen=True, eq=False)
class Refinement:
    """Points on the triangles of a mesh, and triangles of these, which lie in those of the mesh."""

    corners: Array
    """(n, 3) vertices of the mesh at the corners of the triangle that a point is on."""
    shares: Array
    """(n, 3) their shares in it; they add up to 1."""
    faces: Array
    """(m, 3) indices of points, in the order of the mesh's triangles."""
    rgba: Array
    """(n, 4) colours of the points."""

    def spread(self, values: Array) -> Array:
        """Return the points' values (n, k) of the vertices' values."""
        return np.einsum("nc,nck->nk", self.shares.astype(values.dtype), values[self.corners])


def choose_cell(vertices: Array, faces: Array, paint: Paint, most: int = MOST_CELLS) -> tuple[Array, float]:
    """Return by triangle whether a picture shows more than its corners tell, and the length of cells that shows it with
    `most` cells or few more, metres."""
    wrong = _measure_error(faces, paint) > _SEEN
    edges = _longest_edges(vertices, faces)[wrong]
    cell = _CELL
    while (_choose_parts(edges, cell) ** 2).sum() > most and cell < edges.max():
        cell *= _COARSER
    return wrong, cell


def refine(vertices: Array, faces: Array, wrong: Array, cell: float, paint: Paint) -> Refinement:
    """Part the triangles that are chosen into cells of about this length; all others keep their vertices' colours."""
    parts = np.where(wrong, _choose_parts(_longest_edges(vertices, faces), cell), 1)
    plain = refine_nothing(faces[parts == 1], np.empty((len(vertices), 0)))
    corners, shares, found = [plain.corners], [plain.shares], [plain.faces]
    start = len(vertices)
    for count in np.unique(parts[parts > 1]).tolist():
        points, cells = part_triangle(count)
        own = faces[parts == count]
        corners.append(np.repeat(own, len(points), axis=0))
        shares.append(np.tile(points, (len(own), 1)))
        firsts = start + len(points) * np.arange(len(own))
        found.append((cells + firsts[:, None, None]).reshape(-1, 3))
        start += len(own) * len(points)
    return _share_points(np.concatenate(corners), np.concatenate(shares), np.concatenate(found), paint)


def refine_nothing(faces: Array, rgba: Array) -> Refinement:
    """Take the vertices of a mesh as the points, with their colours (n, 4)."""
    corners = np.repeat(np.arange(len(rgba))[:, None], 3, axis=1)
    return Refinement(corners, np.tile([1.0, 0.0, 0.0], (len(rgba), 1)), faces, rgba)


@cache
def part_triangle(count: int) -> tuple[Array, Array]:
    """Return a triangle's points (n, 3), as shares of its corners, and its count ** 2 cells, `count` at an edge."""
    place = {(i, j): 0 for i in range(count + 1) for j in range(count + 1 - i)}
    place = {at: number for number, at in enumerate(place)}
    points = np.array([(count - i - j, i, j) for i, j in place]) / count
    upright = [(place[i, j], place[i + 1, j], place[i, j + 1]) for i, j in place if i + j < count]
    turned = [(place[i + 1, j], place[i + 1, j + 1], place[i, j + 1]) for i, j in place if i + j < count - 1]
    return points, np.array(upright + turned)


def _share_points(corners: Array, shares: Array, faces: Array, paint: Paint) -> Refinement:
    """Make one of points that are the same: on an edge, which two triangles have, and at its ends."""
    order = np.argsort(np.where(shares > 0, corners, -1), axis=1, kind="stable")
    corners, shares = np.take_along_axis(corners, order, axis=1), np.take_along_axis(shares, order, axis=1)
    rows = np.column_stack([np.where(shares > 0, corners, -1), np.rint(shares * 2**20)])
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    at, of = corners[first], shares[first]
    return Refinement(at, of, number.reshape(-1)[faces], paint(at, of))


def _measure_error(faces: Array, paint: Paint) -> Array:
    """Return by triangle the most by which its corners' colours are wrong within it."""
    points, _ = part_triangle(_PROBE)
    true = paint(np.repeat(faces, len(points), axis=0), np.tile(points, (len(faces), 1))).reshape(len(faces), -1, 4)
    ends = [int(np.flatnonzero(points[:, corner] == 1)[0]) for corner in range(3)]
    return np.abs(true - points @ true[:, ends]).max(axis=(1, 2), initial=0.0)


def _longest_edges(vertices: Array, faces: Array) -> Array:
    at = vertices[faces]
    return np.linalg.norm(at - np.roll(at, 1, axis=1), axis=2).max(axis=1)


def _choose_parts(edges: Array, cell: float) -> Array:
    return np.clip(np.ceil(edges / cell), 1, _MOST_PARTS).astype(np.int64)


@dataclass(frozen=True, eq=False)
class CharacterMesh:
    """Triangles of a character in its rest pose, in which every joint frame is aligned with the world."""

    vertices: Array
    """(n, 3) in the rest pose, metres."""
    normals: Array
    """(n, 3) of length 1, one a vertex, in the rest pose."""
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
    fine: Refinement | None = None
    """Finer triangles with colours, which are drawn instead where there are some."""

    def pose(self, positions: Array, turns: Array) -> tuple[Array, Array]:
        """Return vertices (n, 3) and unit normals (n, 3) of one pose.

        `positions` (joints, 3) are the joints' in the world, metres; `turns` (joints, 3, 3) their world rotations
        against the rest pose, as those of a `Motion` that was read from a character's file.
        """
        # In 32 bits, twice as fast, and still exact to a micrometre: for that the origin must be near the body.
        centre = positions[0]
        matrices = np.empty((len(turns), 3, 4), np.float32)
        matrices[..., :3] = turns
        matrices[..., 3] = positions - centre - np.einsum("jab,jb->ja", turns, self.rest)
        blended = (self._shares @ matrices.reshape(-1, 12)).reshape(-1, 3, 4)
        local, outward = self._local
        vertices = np.einsum("nab,nb->na", blended, local)
        normals = np.einsum("nab,nb->na", blended[..., :3], outward)
        lengths = np.sqrt(np.einsum("na,na->n", normals, normals))
        return vertices + centre, normals / np.maximum(lengths, 1e-12)[:, None]

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
        fine=_merge_refinements(meshes) if any(mesh.fine is not None for mesh in meshes) else None,
    )


def _merge_refinements(meshes: list[CharacterMesh]) -> Refinement:
    fine = [refine_nothing(mesh.faces, mesh.rgba) if mesh.fine is None else mesh.fine for mesh in meshes]
    vertices = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    points = np.cumsum([0, *(len(one.corners) for one in fine)])
    return Refinement(
        np.concatenate([one.corners + start for one, start in zip(fine, vertices, strict=False)]),
        np.concatenate([one.shares for one in fine]),
        np.concatenate([one.faces + start for one, start in zip(fine, points, strict=False)]),
        np.concatenate([one.rgba for one in fine]),
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
