"""A mesh parted by colour: what can show one colour only shows it piece by piece."""

from dataclasses import dataclass

import numpy as np

from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.primitives import Array

_NEAR = 0.03  # of a colour, 0 to 1, within which triangles are alike
_OPAQUE = 0.999


@dataclass(frozen=True, eq=False)
class ColourGroup:
    """Triangles that are shown in one colour."""

    faces: Array
    """(m, 3) vertex indices of the mesh."""
    rgba: Array
    """(4,) sRGB colour and opacity, 0 to 1: their mean by area."""


def part_by_colour(mesh: CharacterMesh, most: int) -> list[ColourGroup]:
    """Part the triangles into at most so many groups of similar colour, opaque ones apart from others.

    The group that differs most within, by area, is halved at its mean along the channel in which it does (median cut,
    Heckbert 1982), until all are alike or there are enough.
    """
    rgba, area = mesh.rgba[mesh.faces].mean(axis=1), _measure_areas(mesh)
    opaque = rgba[:, 3] >= _OPAQUE
    groups = [np.flatnonzero(mask) for mask in (opaque, ~opaque) if mask.any()]
    while len(groups) < most:
        spreads = [_measure_spread(rgba[group], area[group]) for group in groups]
        worst = max(range(len(groups)), key=lambda k: spreads[k].max())
        channel = int(spreads[worst].argmax())
        values = rgba[groups[worst], channel]
        if np.ptp(values) < _NEAR:
            break
        low = values <= np.average(values, weights=area[groups[worst]])
        groups[worst : worst + 1] = [groups[worst][low], groups[worst][~low]]
    return [ColourGroup(mesh.faces[group], np.average(rgba[group], axis=0, weights=area[group])) for group in groups]


def _measure_areas(mesh: CharacterMesh) -> Array:
    """Return the triangles' areas, square metres, none of them zero."""
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.linalg.norm(across, axis=1) / 2 + 1e-12


def _measure_spread(rgba: Array, area: Array) -> Array:
    """Return by channel the variance times the area."""
    apart = rgba - np.average(rgba, axis=0, weights=area)
    spread = (area[:, None] * apart**2).sum(axis=0)
    return np.where(np.ptp(rgba, axis=0) < _NEAR, 0.0, spread)
