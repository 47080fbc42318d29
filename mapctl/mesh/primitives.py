"""Coloured triangles, the unit sphere and frames along vectors."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

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


@cache
def unit_sphere(around: int = 16, up: int = 10) -> tuple[Array, Array]:
    """Return the unit sphere (n, 3) about the y axis and its triangles."""
    polar = (np.arange(up) + 0.5) * np.pi / up
    turn = (np.arange(around) + 0.5) * 2 * np.pi / around
    ring = np.stack([np.sin(turn), np.zeros(around), np.cos(turn)], axis=-1)
    points = np.sin(polar)[:, None, None] * ring + np.cos(polar)[:, None, None] * np.array([0.0, 1.0, 0.0])
    index = np.arange(up * around).reshape(up, around)
    a, b = index[:-1], index[1:]
    right = [np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)]
    quads = np.stack([a, b, right[1], right[0]], axis=-1).reshape(-1, 4)
    sides = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    fan = np.stack([np.zeros(around - 2, int), np.arange(1, around - 1), np.arange(2, around)], axis=-1)
    caps = np.concatenate([index[0][fan], index[-1][fan[:, ::-1]]])
    return points.reshape(-1, 3), np.concatenate([sides, caps])


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
