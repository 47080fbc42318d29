"""Light on bodies, computed at their vertices: the same in every renderer, and cheap where pixels are slow.

A soft key lamp with a wide highlight, light from the sky and a little back from the floor, and a thin bright rim that
lifts a figure off the ground. All in linear light; sRGB in and out (gamma 2.2).
"""

import numpy as np

from mapctl.mesh.primitives import Array, Surface, unit
from scenes.overlays import LIGHT

_KEY, _WRAP = 0.78, 0.25
_SKY, _FLOOR = np.array([0.40, 0.42, 0.46]), np.array([0.20, 0.19, 0.18])
_HIGHLIGHT, _SHARPNESS = 0.16, 22.0
_RIM = 0.10
_GAMMA = 2.2


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
