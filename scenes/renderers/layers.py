"""What is drawn at once: solids, what is seen from both sides, and what one sees through, with light in its colours."""

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from mapctl.mesh.primitives import Array, Surface, merge_surfaces
from scenes.renderers.lighting import shade

_OPAQUE = 0.999


class Layer(Enum):
    """How triangles cover what is behind them."""

    CLOSED = "solids, from outside"
    OPEN = "from both sides"
    SHEER = "seen through, in the order of the faces"


def list_layers(ground: Sequence[Surface], bodies: Sequence[Surface], eye: Array) -> dict[Layer, Surface]:
    """List what there is of each layer, shaded as seen from `eye` (3,); layers without a triangle are left out.

    Sheer is the ground, and over it the triangles of bodies that are not opaque, the furthest first.
    """
    lit = [_shade_flat(body, eye) for body in bodies]
    solid, sheer = zip(*map(_split_sheer, lit), strict=True) if lit else ((), ())
    hazy = [body for body in sheer if len(body.faces)]
    layers = {
        Layer.CLOSED: [body for body in solid if not body.is_open],
        Layer.OPEN: [body for body in solid if body.is_open and len(body.faces)],
        Layer.SHEER: [*(_shade_flat(one, eye) for one in ground), *_sort_far_first(hazy, eye)],
    }
    return {layer: merge_surfaces(surfaces) for layer, surfaces in layers.items() if surfaces}


def _shade_flat(surface: Surface, eye: Array) -> Surface:
    """Put the light into the colours of the vertices."""
    return replace(surface, rgba=shade(surface, eye), normals=None)


def _split_sheer(surface: Surface) -> tuple[Surface, Surface]:
    """Part opaque triangles from those that are not; vertices of opaque ones tell no opacity, by which a mesh as a
    whole would count as one that is seen through."""
    if (surface.rgba[:, 3] >= _OPAQUE).all():
        return surface, replace(surface, faces=surface.faces[:0])
    hazy = (surface.rgba[surface.faces, 3] < _OPAQUE).any(axis=1)
    plain = np.column_stack([surface.rgba[:, :3], np.ones(len(surface.rgba))])
    return replace(surface, faces=surface.faces[~hazy], rgba=plain), replace(surface, faces=surface.faces[hazy])


def _sort_far_first(surfaces: Sequence[Surface], eye: Array) -> list[Surface]:
    """Merge surfaces into one whose triangles are in the order of their distance from the eye; none of none."""
    if not surfaces:
        return []
    whole = merge_surfaces(surfaces)
    away = np.linalg.norm(whole.vertices[whole.faces].mean(axis=1) - eye, axis=1)
    return [replace(whole, faces=whole.faces[np.argsort(-away)])]
