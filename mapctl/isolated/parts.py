"""Parts of a character's mesh, as a file has them: what carries every vertex, in frames of the file's own joints."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

Array = np.ndarray
MOST_CARRIERS = 8
"""Most joints that carry one vertex; weaker ones are left out."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles with one table of what carries them."""

    points: Array
    """(n, 3) vertices in the mesh's own frame."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    rgba: Array
    """(n, 4) sRGB colour and opacity, 0 to 1."""
    joints: Array
    """(p,) indices of joints."""
    matrices: Array
    """(p, 4, 4) from the mesh's frame to the joint's, as at the time of binding."""
    rows: Array
    """(n, k) indices in `joints` of what carries a vertex."""
    shares: Array
    """(n, k) how much; each vertex's add up to 1."""


def pack_parts(parts: Sequence[MeshPart]) -> dict[str, Array]:
    """Return the tables of all parts, named `NUMBER.FIELD`."""
    return {f"{k}.{field.name}": getattr(part, field.name) for k, part in enumerate(parts) for field in fields(part)}


def unpack_parts(tables: dict[str, Array], count: int) -> list[MeshPart]:
    """Undo `pack_parts`."""
    return [MeshPart(*(tables[f"{k}.{field.name}"] for field in fields(MeshPart))) for k in range(count)]


def strongest(vertices: Array, carriers: Array, weights: Array, count: int) -> tuple[Array, Array]:
    """Return tables (count, k) of the strongest carriers of each vertex and their shares, of triples in any order.

    Vertices without any are carried by 0 alone.
    """
    kept = (weights > 0) & np.isfinite(weights) & (vertices >= 0) & (vertices < count)
    vertices, carriers, weights = vertices[kept], carriers[kept], weights[kept]
    order = np.lexsort((-weights, vertices))
    vertices, carriers, weights = vertices[order], carriers[order], weights[order]
    first = np.searchsorted(vertices, vertices)
    rank = np.arange(len(vertices)) - first
    width = int(min(rank.max(initial=0) + 1, MOST_CARRIERS))
    rows, shares = np.zeros((count, width), np.int64), np.zeros((count, width))
    near = rank < width
    rows[vertices[near], rank[near]] = carriers[near]
    shares[vertices[near], rank[near]] = weights[near]
    total = shares.sum(axis=1, keepdims=True)
    shares[total[:, 0] <= 0, 0] = 1.0
    return rows, shares / np.where(total > 0, total, 1.0)
