"""Layers of a picture, with light in their colours: solids, what is seen from both sides, what one sees through.

Light is computed at vertices, the same in every renderer, and cheap where pixels are slow: a soft key lamp with a wide
highlight, light from the sky and a little back from the floor, and a thin bright rim that lifts a figure off the
ground. All in linear light; sRGB in and out (gamma 2.2).
"""

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np

from mapctl.mesh.primitives import Array, Surface, merge_surfaces, unit
from scenes.overlays import LIGHT

_OPAQUE = 0.999
_KEY, _WRAP = 0.78, 0.25
_SKY, _FLOOR = np.array([0.40, 0.42, 0.46]), np.array([0.20, 0.19, 0.18])
_HIGHLIGHT, _SHARPNESS = 0.16, 22.0
_RIM = 0.10
_GAMMA = 2.2


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


def shade(surface: Surface, eye: Array) -> Array:
    """Return (n, 4) sRGB of a lit surface as seen from `eye` (3,); a flat one keeps its colours."""
    if surface.normals is None:
        return surface.rgba
    normals, to_eye = surface.normals, unit(eye - surface.vertices)
    towards_lamp = -LIGHT
    facing = normals @ towards_lamp
    key = _KEY * np.clip((facing + _WRAP) / (1 + _WRAP), 0, None)
    sky = (normals[:, 1:2] + 1) / 2
    light = key[:, None] + _FLOOR + (_SKY - _FLOOR) * sky
    halfway = unit(to_eye + towards_lamp)
    shine = _HIGHLIGHT * np.clip(np.einsum("ij,ij->i", normals, halfway), 0, None) ** _SHARPNESS * (facing > 0)
    rim = _RIM * (1 - np.clip(np.einsum("ij,ij->i", normals, to_eye), 0, 1)) ** 3 * sky[:, 0]
    linear = surface.rgba[:, :3] ** _GAMMA * light + (shine + rim)[:, None]
    return np.column_stack([np.clip(linear, 0, 1) ** (1 / _GAMMA), surface.rgba[:, 3]])
