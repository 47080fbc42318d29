"""The path in the browser: its curve, balls at its points that are dragged, and small ones between them that become
points."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import trimesh
import viser

from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.live.ground import to_rgb_bytes
from scenes.live.paths.points import PathPoints, Point, sample_curve

_LINE_HEIGHT, _BALL_HEIGHT = 0.02, 0.03  # metres over the ground
_BALL_RADIUS, _FIRST_SCALE, _BETWEEN_SCALE = 0.075, 1.35, 0.6  # the first point's ball is larger than the others
_WHITE = (255, 255, 255)

Ray = tuple[Any, Any]
"""Origin and direction, three numbers each, as a browser sent them."""
Dragged = Callable[[int, str, Ray], None]
"""Hears the index of what is dragged, the phase of the drag (`start`, `update`, `end`), and where the mouse points."""
Clicked = Callable[[int, bool], None]
"""Hears the index of what was clicked, and whether Ctrl was held."""


class PathHandles:
    """Line and balls below a node of the scene."""

    def __init__(self, scene: viser.SceneApi, name: str, *, drag: Dragged, drag_between: Dragged, click: Clicked):
        """`drag` and `click` hear of points, `drag_between` of the places between, on a browser's own time."""
        self._line: viser.LineSegmentsHandle | None = None
        self._scene, self._name = scene, name
        self._points = _Balls(scene, f"{name}/points", drag, click)
        self._between = _Balls(scene, f"{name}/between", drag_between, None)

    def show(self, path: PathPoints, *, keep_between: bool = False) -> None:
        """Show a path; the places between stay as they are while one of them is dragged."""
        count = len(path.points)
        colour = np.tile(to_rgb_bytes(colours.TARGET), (count, 1))
        if path.selected is not None and path.selected < count:
            colour[path.selected] = _WHITE
        self._points.show(path.points, colour, np.r_[_FIRST_SCALE, np.ones(max(0, count - 1))][:count])
        if not keep_between:
            places = path.midpoints()
            faint = np.tile(to_rgb_bytes(colours.TRAIL), (len(places), 1))
            self._between.show(places, faint, np.full(len(places), _BETWEEN_SCALE))
        self._show_line(path)

    def _show_line(self, path: PathPoints) -> None:
        curve = path.curve
        if curve is None:
            if self._line is not None:
                self._line.remove()
                self._line = None
            return
        line = np.insert(sample_curve(curve), 1, _LINE_HEIGHT, axis=1).astype(np.float32)
        segments = np.stack([line[:-1], line[1:]], axis=1)
        if self._line is not None and self._line.points.shape == segments.shape:
            self._line.points = segments
        else:
            self._line = self._scene.add_line_segments(
                f"{self._name}/line", segments, to_rgb_bytes(colours.TARGET), thickness=0.025
            )


def find_ball(points: Sequence[Point], ray: Array) -> int | None:
    """Find the ball that a ray (origin and direction, (2, 3), metres) meets first; None where it meets none."""
    if not points:
        return None
    origin, direction = ray[0], ray[1] / max(1e-9, float(np.linalg.norm(ray[1])))
    apart = np.insert(np.array(points), 1, _BALL_HEIGHT, axis=1) - origin
    along = apart @ direction
    radius = _BALL_RADIUS * np.r_[_FIRST_SCALE, np.ones(len(points) - 1)]
    hit = (np.linalg.norm(apart - along[:, None] * direction, axis=1) <= radius) & (along > 0)
    return int(np.where(hit, along, np.inf).argmin()) if hit.any() else None


class _Balls:
    """Balls that are one node: they are added anew where their number changes, and else moved."""

    def __init__(self, scene: viser.SceneApi, name: str, drag: Dragged, click: Clicked | None):
        self._scene, self._name, self._drag, self._click = scene, name, drag, click
        self._handle: viser.BatchedMeshHandle | None = None
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_BALL_RADIUS)
        self._vertices, self._faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.uint32)

    def show(self, points: Sequence[Point], colour: np.ndarray, scales: np.ndarray) -> None:
        places = np.insert(np.array(points, np.float32).reshape(-1, 2), 1, _BALL_HEIGHT, axis=1)
        if self._handle is not None and len(self._handle.batched_positions) != len(points):
            self._handle.remove()
            self._handle = None
        if not points:
            return
        if self._handle is None:
            self._handle = self._add(places, colour, scales)
        else:
            self._handle.batched_positions = places
            self._handle.batched_colors = colour.astype(np.uint8)

    def _add(self, places: np.ndarray, colour: np.ndarray, scales: np.ndarray) -> viser.BatchedMeshHandle:
        handle = self._scene.add_batched_meshes_simple(
            self._name,
            self._vertices,
            self._faces,
            np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(places), 1)),
            places,
            batched_scales=scales.astype(np.float32),
            batched_colors=colour.astype(np.uint8),
            lod="off",
            cast_shadow=False,
        )
        _report_drags(handle, self._drag)
        if self._click is not None:
            _report_clicks(handle, self._click)
        return handle


def _report_drags(handle: viser.BatchedMeshHandle, drag: Dragged) -> None:
    """Say what is dragged, and the ray from the browser's camera through the mouse. A coroutine, so that drags stay in
    order."""

    @handle.on_drag("left")
    async def _(event: viser.SceneNodeDragEvent) -> None:
        if event.instance_index is not None:
            origin = np.asarray(event.client.camera.position)
            drag(event.instance_index, event.phase, (origin, np.asarray(event.end_position) - origin))


def _report_clicks(handle: viser.BatchedMeshHandle, click: Clicked) -> None:
    @handle.on_click
    async def _(event: viser.SceneNodePointerEvent) -> None:
        if event.instance_index is not None:
            click(event.instance_index, False)

    @handle.on_click(modifier="cmd/ctrl")
    async def _(event: viser.SceneNodePointerEvent) -> None:
        if event.instance_index is not None:
            click(event.instance_index, True)
