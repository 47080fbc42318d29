"""Finer triangles where a picture shows more than the colours of a mesh's vertices can: flat, and moved by these."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

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
