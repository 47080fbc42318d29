"""Marks on the ground of the live viewer: grid, drawn path, planted feet, and the forecast of the next second."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import viser

from mapctl import curves
from mapctl.errors import RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from mapctl.skeleton import TOES, Skeleton

_PATH_HEIGHT, _MARK_HEIGHT = 0.012, 0.008  # metres over the ground, so that neither flickers
_FIGURE_SHARES = (0.5, 1.0)  # shares of the forecast at which it is shown as a stick figure
_SPACING = 0.05  # metres between the points of a path as it is shown, or more where it is long
_MAX_COORDINATE = 1e5  # metres from the origin beyond which nobody looks
_MAX_SHOWN_POINTS, _MAX_DRAWN_POINTS = 1500, 200  # points of a path as it is shown, and as it is drawn


def add_grid(scene: viser.SceneApi, name: str) -> None:
    """Add squares of a metre, every fifth line stronger, as far as the eye goes."""
    scene.add_grid(
        name,
        plane="xz",
        infinite_grid=True,
        cell_size=1.0,
        section_size=5.0,
        cell_thickness=0.8,
        section_thickness=1.4,
        fade_distance=40.0,
        cell_color=to_rgb_bytes(colours.GRID),
        section_color=to_rgb_bytes(colours.GRID),
    )


class GroundMarks:
    """Planted feet and forecast of one character."""

    def __init__(self, scene: viser.SceneApi, name: str, skeleton: Skeleton):
        self._scene, self._name, self._parents = scene, name, skeleton.parents
        self._toes = skeleton.indices(TOES)
        vertices, faces = _build_disc()
        self._feet = [
            scene.add_mesh_simple(
                f"{name}/foot{k}",
                vertices,
                faces,
                color=to_rgb_bytes(colour),
                opacity=0.6,
                visible=False,
                side="double",
                cast_shadow=False,
            )
            for k, colour in enumerate((colours.LEFT, colours.RIGHT))
        ]

    def planted(self, joints: Array, contacts: Array) -> None:
        """Show a disc below each toe (of joints (joints, 3)) whose contact (2,) is 1."""
        for foot, toe, contact in zip(self._feet, self._toes, contacts, strict=True):
            foot.visible = bool(contact > 0.5)
            if foot.visible:
                foot.position = (joints[toe, 0], _MARK_HEIGHT, joints[toe, 2])

    def forecast(self, joints: Array) -> None:
        """Show the hips' trajectory over the ground and two stick figures of (frames, joints, 3)."""
        if len(joints) < 2:
            return
        way = joints[:, 0] * np.array([1.0, 0.0, 1.0]) + np.array([0.0, _PATH_HEIGHT, 0.0])
        segments = [np.stack([way[:-1], way[1:]], axis=1)]
        bones = [(child, parent) for child, parent in enumerate(self._parents) if parent >= 0]
        segments += [joints[round(share * (len(joints) - 1))][np.array(bones)] for share in _FIGURE_SHARES]
        lines = np.concatenate(segments).astype(np.float32)
        self._scene.add_line_segments(f"{self._name}/forecast", lines, to_rgb_bytes(colours.TRAIL), thickness=0.012)


class DrawnPath:
    """Points that a user set on the ground, and the smooth curve through them."""

    def __init__(self, scene: viser.SceneApi, name: str):
        self._scene, self._name = scene, name
        self.points: list[tuple[float, float]] = []
        self._shown: list[viser.SceneNodeHandle] = []

    def add(self, x: float, z: float) -> None:
        """Add one more point, metres. RequestError where there are very many."""
        if len(self.points) >= _MAX_DRAWN_POINTS:
            raise RequestError(f"a drawn path has at most {_MAX_DRAWN_POINTS} points")
        self.points.append((x, z))
        self._redraw()

    def clear(self) -> None:
        """Remove all points."""
        self.points.clear()
        self._redraw()

    def _redraw(self) -> None:
        for handle in self._shown:
            handle.remove()
        self._shown = [
            self._scene.add_icosphere(
                f"{self._name}/point{k}", 0.05, color=to_rgb_bytes(colours.TARGET), position=(x, 0.02, z)
            )
            for k, (x, z) in enumerate(self.points)
        ]
        if (line := _sample_curve(self.points)) is not None:
            segments = np.stack([line[:-1], line[1:]], axis=1).astype(np.float32)
            self._shown.append(
                self._scene.add_line_segments(
                    f"{self._name}/line", segments, to_rgb_bytes(colours.TARGET), thickness=0.025
                )
            )


def parse_ray(origin: Any, direction: Any) -> Array:
    """Parse a ray (2, 3) from a browser; RequestError where it is none near the stage."""
    with suppress(TypeError, ValueError):
        ray = np.array([origin, direction], dtype=np.float64)
        if ray.shape == (2, 3) and np.isfinite(ray).all() and np.abs(ray).max() <= _MAX_COORDINATE:
            return ray
    raise RequestError("a click that is nowhere")


def intersect_ground(origin: Array, direction: Array) -> tuple[float, float] | None:
    """Return the x and z where a ray (two of (3,)) meets y = 0; None where it does not, or beyond 100 m."""
    if direction[1] > -1e-3:
        return None
    far = -origin[1] / direction[1]
    return (float(origin[0] + far * direction[0]), float(origin[2] + far * direction[2])) if 0 < far < 100 else None


def _sample_curve(points: Sequence[tuple[float, float]]) -> Array | None:
    try:
        curve = curves.through(np.array(points, dtype=np.float64).reshape(-1, 2))
    except RequestError:
        return None  # one point, or all at one position: no curve yet
    arcs = np.linspace(0, curve.length, min(_MAX_SHOWN_POINTS, max(2, round(curve.length / _SPACING))))
    places = np.array([curve.point(float(arc)).tolist() for arc in arcs])
    return np.insert(places, 1, _PATH_HEIGHT, axis=1)


def _build_disc(radius: float = 0.085, corners: int = 24) -> tuple[Array, Array]:
    turn = np.arange(corners) * 2 * np.pi / corners
    rim = np.stack([radius * np.sin(turn), np.zeros(corners), radius * np.cos(turn)], axis=-1)
    index = np.arange(1, corners + 1)
    return np.vstack([np.zeros(3), rim]), np.stack([np.zeros(corners, int), index, np.roll(index, -1)], axis=-1)


def to_rgb_bytes(colour: str) -> tuple[int, int, int]:
    """Return a colour as viser takes it, 0 to 255."""
    red, green, blue = (round(255 * float(share)) for share in colours.rgb(colour))
    return red, green, blue
