"""Coloured triangles, and frames along vectors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles with a colour at every vertex; drawn in the order of its faces."""

    vertices: Array
    """(n, 3) world positions, metres."""
    faces: Array
    """(m, 3) vertex indices, counter-clockwise seen from outside."""
    rgba: Array
    """(n, 4) sRGB colour and opacity, 0 to 1."""
    normals: Array | None = None
    """(n, 3) unit normals of a lit surface; None for flat colour."""


def merge_surfaces(surfaces: Sequence[Surface]) -> Surface:
    """Merge surfaces into one, faces in the order given; all are lit or none is."""
    counts = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    lit = surfaces[0].normals is not None
    return Surface(
        vertices=np.concatenate([s.vertices for s in surfaces]),
        faces=np.concatenate([s.faces + start for s, start in zip(surfaces, counts, strict=False)]),
        rgba=np.concatenate([s.rgba for s in surfaces]),
        normals=np.concatenate([s.normals for s in surfaces if s.normals is not None]) if lit else None,
    )


def frame_along(axis: Array, across: Array) -> Array:
    """Return (..., 3, 3) rotations whose y column is `axis` and whose x column is as near to `across` as can be."""
    y = unit(np.where(np.linalg.norm(axis, axis=-1, keepdims=True) > 1e-9, axis, np.array([0.0, 1.0, 0.0])))
    z = np.cross(across, y)
    fallback = np.cross(np.where(np.abs(y[..., :1]) < 0.7, np.array([1.0, 0, 0]), np.array([0, 0, 1.0])), y)
    z = unit(np.where(np.linalg.norm(z, axis=-1, keepdims=True) > 1e-6, z, fallback))
    return np.stack([np.cross(y, z), y, z], axis=-1)


def unit(vector: Array) -> Array:
    """Normalise vectors to length one; zero stays zero."""
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)
