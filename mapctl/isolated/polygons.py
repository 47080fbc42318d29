"""Polygons as triangles, and colours of their corners as colours of vertices."""

import numpy as np

Array = np.ndarray


def split_polygons(counts: Array, skipped: Array | None = None) -> tuple[Array, Array]:
    """Return triangles (m, 3) as indices of corners, each polygon a fan around its first corner, and (m,) the polygon
    that each is of. `counts` (polygons,) are their numbers of corners; polygons with fewer than 3, and those of
    `skipped` (polygons,), have none."""
    counts = np.asarray(counts, np.int64)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]) if len(counts) else counts
    triangles = np.maximum(counts - 2, 0)
    if skipped is not None:
        triangles = np.where(skipped, 0, triangles)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    number = np.arange(len(polygon)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    first = starts[polygon]
    return np.stack([first, first + number + 1, first + number + 2], axis=1), polygon


def mean_at_vertices(corners: Array, vertices: Array, count: int) -> Array:
    """Return the mean (count, width) of values at corners (n, width), which belong to `vertices` (n,); a vertex without
    corners has 0.8."""
    total, number = np.zeros((count, corners.shape[1])), np.zeros(count)
    np.add.at(total, vertices, corners)
    np.add.at(number, vertices, 1.0)
    return np.where(number[:, None] > 0, total / np.maximum(number, 1.0)[:, None], 0.8)
