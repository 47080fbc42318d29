"""A curve object as the points of mapctl's curve files: x and z in metres, on the ground."""

from pathlib import Path

import bpy
import numpy as np

from ..problem import AddonError
from .body import Y_UP

_LEVEL = 0.05  # metres that a level curve may rise and fall


def sample_curve(drawn: bpy.types.Object, scene: bpy.types.Scene) -> np.ndarray:
    """Sample a curve in the world at its own resolution, without bevel, extrusion and modifiers: (points, 3) in metres,
    Y up, the first point again at the end of a cyclic one. AddonError for curves that are not one line."""
    splines = drawn.data.splines
    if len(splines) != 1:
        raise AddonError(f"{drawn.name} has {len(splines)} splines; a character follows a curve of one")
    plain = drawn.data.copy()
    holder = bpy.data.objects.new(drawn.name, plain)
    try:
        plain.bevel_depth = plain.extrude = plain.offset = 0.0
        plain.bevel_object = plain.taper_object = None
        plain.use_fill_caps = False
        if plain.dimensions == "2D":
            plain.fill_mode = "NONE"
        local = np.array([vertex.co for vertex in holder.to_mesh().vertices], dtype=np.float64).reshape(-1, 3)
        holder.to_mesh_clear()
    finally:
        bpy.data.objects.remove(holder)
        bpy.data.curves.remove(plain)
    if len(local) < 2:
        raise AddonError(f"{drawn.name} has no length")
    matrix = np.array(drawn.matrix_world, dtype=np.float64)
    world = (local @ matrix[:3, :3].T + matrix[:3, 3]) @ Y_UP.T * scene.unit_settings.scale_length
    return np.concatenate([world, world[:1]]) if splines[0].use_cyclic_u else world


def write_curve(points: np.ndarray, path: Path) -> None:
    """Write the points as a table of x and z."""
    np.savetxt(path, points[:, ::2], fmt="%.6f", delimiter=",", header="x,z", comments="")


def measure_height(points: np.ndarray) -> tuple[float, bool]:
    """Measure how high the curve is, metres, and whether it is level."""
    heights = points[:, 1]
    return float(np.median(heights)), bool(np.ptp(heights) <= _LEVEL)
