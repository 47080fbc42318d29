"""Closed surfaces around limbs that blend into each other: tapered solids of elliptic sections, meshed once.

The field is a smooth union of signed distances, -k log sum exp(-d/k); its zero set is meshed by surface nets (Gibson
1998): one vertex in each cell that the surface crosses, one quad for each edge of the grid that it crosses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from mapctl.mesh.primitives import Array, frame_along

_BLEND = 0.011
"""Softness k of the union, metres at scale 1."""
_REACH = 3.5
"""Distance, in k, beyond which a solid adds nothing."""
_FAR = 20.0
"""Argument at which exp is cut off."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A limb, or a part of one: elliptic sections along an axis, with round ends."""

    start: Array
    """(3,) beginning of the axis, metres."""
    end: Array
    """(3,) its end."""
    across: Array
    """(3,) direction of the sections' width, made square to the axis."""
    sections: Array
    """(n, 5) rows that rise: share of the axis, half width, half depth, and the section's offset along width and depth,
    metres."""
    floor: float = -np.inf
    """Height at which it is cut off, metres."""

    @cached_property
    def frame(self) -> Array:
        """(3, 3) columns width, axis and depth."""
        return frame_along(self.end - self.start, self.across)

    @cached_property
    def _profile(self) -> scipy.interpolate.PchipInterpolator:
        return scipy.interpolate.PchipInterpolator(self.sections[:, 0], self.sections[:, 1:])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners of a box around it."""
        rows, length = self.sections, np.linalg.norm(self.end - self.start)
        low = np.array([rows[:, 3] - rows[:, 1], length * rows[:, 0], rows[:, 4] - rows[:, 2]])
        high = np.array([rows[:, 3] + rows[:, 1], length * rows[:, 0], rows[:, 4] + rows[:, 2]])
        round_end = rows[[0, -1], 1:3].mean(axis=1)
        low, high = low.min(axis=1), high.max(axis=1)
        low[1], high[1] = low[1] - round_end[0], high[1] + round_end[1]
        corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3) @ self.frame.T
        return self.start + corners.min(axis=0), self.start + corners.max(axis=0)

    def share(self, points: Array) -> Array:
        """Return the share of the axis (n,) at which points (n, 3) lie, within that of the sections."""
        along = (points - self.start) @ self.frame[:, 1] / max(np.linalg.norm(self.end - self.start), 1e-9)
        return np.clip(along, self.sections[0, 0], self.sections[-1, 0])

    def distance(self, points: Array) -> Array:
        """Return signed distances (n,) of points (n, 3), metres, exact near the surface for round sections."""
        local, length = (points - self.start) @ self.frame, np.linalg.norm(self.end - self.start)
        share = self.share(points)
        wide, deep, aside, ahead = self._profile(share).T
        mean = np.sqrt(wide * deep)
        beyond = local[:, 1] - share * length
        q = np.stack([(local[:, 0] - aside) / wide, beyond / mean, (local[:, 2] - ahead) / deep])
        near = np.linalg.norm(q, axis=0)
        # First-order distance to an ellipse: value over gradient.
        slope = np.linalg.norm(q / np.stack([wide, mean, deep]), axis=0)
        found = near * (near - 1) / np.maximum(slope, 1e-9)
        return np.maximum(np.where(near < 1e-3, -mean, found), self.floor - points[:, 1])


def mesh_union(solids: Sequence[Solid], lines: Sequence[Array], scale: float) -> tuple[Array, Array, Array]:
    """Mesh the smooth union of solids on a grid of rising coordinates along x, y and z, metres.

    Returns vertices (n, 3), unit normals (n, 3), and triangles (m, 3), counter-clockwise seen from outside.
    """
    soft = _BLEND * scale
    total = np.zeros([len(line) for line in lines])
    for solid in solids:
        low, high = solid.bounds
        part = tuple(
            slice(*np.searchsorted(line, (a - _REACH * soft, b + _REACH * soft)))
            for line, a, b in zip(lines, low, high, strict=True)
        )
        block = np.stack(np.meshgrid(*(line[s] for line, s in zip(lines, part, strict=True)), indexing="ij"), axis=-1)
        values = np.exp(np.minimum(-solid.distance(block.reshape(-1, 3)) / soft, _FAR))
        total[part] += values.reshape(block.shape[:3])
    field = -soft * np.log(np.maximum(total, np.exp(-_REACH)))
    vertices, faces = _mesh_zero_set(field, lines)
    slope = scipy.interpolate.RegularGridInterpolator(lines, np.moveaxis(np.array(np.gradient(field, *lines)), 0, -1))
    for _ in range(2):  # onto the surface, by Newton's method along the slope
        gradient = slope(vertices)
        distance = -soft * np.log(sum(np.exp(np.clip(-s.distance(vertices) / soft, -_FAR, _FAR)) for s in solids))
        step = distance[:, None] * gradient / np.maximum((gradient**2).sum(axis=1), 0.1)[:, None]
        vertices = vertices - np.clip(step, -0.5 * soft, 0.5 * soft)
    normals = slope(vertices)
    return vertices, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9), faces


def _mesh_zero_set(field: Array, lines: Sequence[Array]) -> tuple[Array, Array]:
    """Return vertices (n, 3) and triangles (m, 3) of the surface on which a field is zero; it is negative inside."""
    shape, inside = field.shape, field < 0
    cells, points, quads = [], [], []
    for axis in range(3):
        low = np.argwhere(np.diff(inside, axis=axis))
        high = low + np.eye(3, dtype=int)[axis]
        a, b = field[tuple(low.T)], field[tuple(high.T)]
        ends = np.stack([np.stack([line[i] for line, i in zip(lines, at.T, strict=True)], 1) for at in (low, high)])
        crossing = ends[0] + (a / (a - b))[:, None] * (ends[1] - ends[0])
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        near = [low, low - u, low - u - v, low - v]
        around = np.stack([np.ravel_multi_index(tuple(cell.T), shape) for cell in near])
        cells.append(around.reshape(-1))
        points.append(np.tile(crossing, (4, 1)))
        quads.append(np.where((a < 0)[:, None], around.T, around.T[:, ::-1]))
    used, number = np.unique(np.concatenate(cells), return_inverse=True)
    sums = np.zeros((len(used), 4))
    np.add.at(sums, number, np.insert(np.concatenate(points), 3, 1.0, axis=1))
    corners = np.searchsorted(used, np.concatenate(quads))
    vertices = sums[:, :3] / sums[:, 3:]
    # The shorter diagonal of each quad makes the better triangles.
    diagonals = [np.linalg.norm(vertices[corners[:, k]] - vertices[corners[:, k + 2]], axis=1) for k in (0, 1)]
    corners = np.where((diagonals[0] <= diagonals[1])[:, None], corners, np.roll(corners, -1, axis=1))
    return vertices, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
