"""Paths on the ground: points that are drawn and dragged, the curve through them, and files of it."""

import math
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import trimesh
import viser

from mapctl import curves
from mapctl.curves.curve import Curve
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.live.camera import WORLD, to_rgb_bytes

if TYPE_CHECKING:
    from scenes.live.app import LiveApp

ENDINGS = (".csv", ".tsv", ".txt", ".svg")
"""Endings of files that are read."""
MAX_POINTS = 200
"""Largest number of points that can be dragged."""
HELP = "Drag a ball to move it; Ctrl and a click removes it."
_MAX_DISTANCE, _MAX_LENGTH = 1000.0, 5000.0  # metres of a point from the origin along x or z, and of a path
_MAX_BYTES = 8 * 2**20  # of a file that a browser sends
_SPACING, _MAX_SAMPLES = 0.05, 1500  # metres between samples of the curve, or more where it is long
_BALL_SPACING = 0.5  # metres between the points of a path that was read
_LINE_HEIGHT, _BALL_HEIGHT, _BALL_RADIUS = 0.02, 0.03, 0.085  # metres over the ground

Point = tuple[float, float]
Ray = tuple[Any, Any]
"""Origin and direction, three numbers each, as a browser sent them."""


def make_curve(points: Sequence[Point], *, closed: bool) -> Curve:
    """Make the smooth curve through points (x, z) in metres; RequestError where they make none, or a very long one."""
    if not 2 <= len(points) <= MAX_POINTS:
        raise RequestError(f"a path needs 2 points or more, and at most {MAX_POINTS}; it has {len(points)}")
    found = np.array(points, dtype=np.float64)
    if not (np.abs(found) <= _MAX_DISTANCE).all():
        raise RequestError(f"a point of the path is more than {_MAX_DISTANCE:g} m from the origin")
    curve = curves.through(found, closed=closed)
    if curve.length > _MAX_LENGTH:
        raise RequestError(f"the path is {curve.length:.0f} m long; allowed are {_MAX_LENGTH:g} m")
    return curve


def sample_curve(curve: Curve, spacing: float = _SPACING, most: int = _MAX_SAMPLES) -> Array:
    """Sample a curve (n, 2) at equal distances of about `spacing` metres; a closed one ends where it begins."""
    count = min(most, max(2, math.ceil(curve.length / spacing) + 1))
    return curve.ground_point(torch.linspace(0, curve.length, count, dtype=torch.float64)).numpy()


def write_csv(curve: Curve) -> bytes:
    """Write a curve as a table of x and z in metres, as `mapctl follow` reads it; a closed one ends where it begins."""
    rows = "\n".join(f"{x:.4f},{z:.4f}" for x, z in sample_curve(curve))
    return f"x,z\n{rows}\n".encode()


def read_path(name: str, content: bytes) -> tuple[list[Point], bool]:
    """Read a table or drawing that a browser sent as a file of this name; return points along it, half a metre apart or
    more where it is long, and whether it is closed. MapctlError names the fault, without this machine's paths."""
    if len(content) > _MAX_BYTES:
        raise RequestError(f"the file has {len(content) / 2**20:.0f} MiB; a path has at most {_MAX_BYTES // 2**20}")
    ending = PurePosixPath(name).suffix.lower()
    if ending not in ENDINGS:
        raise RequestError(f"a path is read from {', '.join(ENDINGS)} files, not from {name[-60:]!r}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"path{ending}"
        file.write_bytes(content)
        try:
            curve = curves.read(file)
        except FileFormatError as error:
            raise RequestError(str(error).replace(str(file), name[-60:])) from None
    samples = sample_curve(curve, _BALL_SPACING, MAX_POINTS)
    points = [(float(x), float(z)) for x, z in (samples[:-1] if curve.closed else samples)]
    make_curve(points, closed=curve.closed)
    return points, curve.closed


class PathEditor:
    """The path in all browsers: a line, and balls at its points, which are dragged and, with Ctrl, removed by a click.

    Its methods are for the loop's thread.
    """

    def __init__(self, app: "LiveApp"):
        self.points: list[Point] = []
        """Points (x, z) in order, metres."""
        self.is_closed = False
        """Whether the last is followed by the first."""
        self._app, self._scene, self._name = app, app.server.scene, f"{WORLD}/path"
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_BALL_RADIUS)
        self._ball = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.uint32)
        self._line: viser.LineSegmentsHandle | None = None
        self._balls: viser.BatchedMeshHandle | None = None

    @property
    def curve(self) -> Curve | None:
        """Smooth curve through the points; None while they make none."""
        with suppress(RequestError):
            return make_curve(self.points, closed=self.is_closed)
        return None

    def edit(self, points: Sequence[Point], *, closed: bool | None = None) -> None:
        """Take other points, and whether they are closed; what cannot be done is shown in the panel, and
        changes nothing."""
        closed = self.is_closed if closed is None else closed
        try:
            if len(points) >= 2 and len(set(points)) > 1:
                make_curve(points, closed=closed)
            self.points, self.is_closed = list(points), closed
            self._show()
        except MapctlError as error:
            self._app.show_path(f"⚠️ {error}")

    def add(self, point: Point) -> None:
        """Add a point at the end, unless a ball is there: browsers report a click on a ball here too."""
        if all(math.dist(point, other) > 2 * _BALL_RADIUS for other in self.points):
            self.edit([*self.points, point])

    def move(self, index: int, point: Point) -> None:
        """Move a point; nothing where it is gone."""
        if index < len(self.points):
            self.edit([*self.points[:index], point, *self.points[index + 1 :]])

    def remove(self, index: int) -> None:
        """Remove a point; nothing where it is gone."""
        self.edit([*self.points[:index], *self.points[index + 1 :]])

    def load(self, name: str, content: bytes) -> None:
        """Take the path of a file that a browser sent."""
        try:
            points, closed = read_path(name, content)
        except MapctlError as error:
            self._app.show_path(f"⚠️ {error}")
        else:
            self.edit(points, closed=closed)

    def _show(self) -> None:
        curve, count, red = self.curve, len(self.points), to_rgb_bytes(colours.TARGET)
        if self._line is not None:
            self._line.remove()
            self._line = None
        if curve is not None:
            line = np.insert(sample_curve(curve), 1, _LINE_HEIGHT, axis=1).astype(np.float32)
            segments = np.stack([line[:-1], line[1:]], axis=1)
            self._line = self._scene.add_line_segments(f"{self._name}/line", segments, red, thickness=0.025)
        positions = np.insert(np.array(self.points, np.float32).reshape(-1, 2), 1, _BALL_HEIGHT, axis=1)
        if self._balls is not None and len(self._balls.batched_positions) == count:
            self._balls.batched_positions = positions  # a drag goes on
        else:
            if self._balls is not None:
                self._balls.remove()
            self._balls = self._add_balls(positions, red) if count else None
        length = "" if curve is None else f", {curve.length:.1f} m"
        self._app.show_path(f"{count} point{'s' * (count != 1)}{length}." if count else HELP)

    def _add_balls(self, positions: Array, colour: tuple[int, int, int]) -> viser.BatchedMeshHandle:
        """Add the balls as one node that reports which of them is dragged or clicked."""
        balls = self._scene.add_batched_meshes_simple(
            f"{self._name}/points",
            *self._ball,
            np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(positions), 1)),
            positions,
            batched_colors=np.tile(np.array(colour, np.uint8), (len(positions), 1)),
            lod="off",
            cast_shadow=False,
        )

        # Coroutines run in the order in which browsers did things; functions run on threads in any order.
        @balls.on_drag("left")
        async def _(event: viser.SceneNodeDragEvent) -> None:
            index, origin = event.instance_index, np.asarray(event.client.camera.position)
            if index is not None and event.phase != "end":  # where a drag ends the mouse may be anywhere
                ray = origin, np.asarray(event.end_position) - origin
                self._app.enqueue(lambda: self.drag(index, ray))

        @balls.on_click(modifier="cmd/ctrl")
        async def _(event: viser.SceneNodePointerEvent) -> None:
            index = event.instance_index
            if index is not None:
                self._app.enqueue(lambda: self.remove(index))

        return balls

    def drag(self, index: int, ray: Ray) -> None:
        """Move a point to where the mouse's ray meets the ground."""
        if (point := self._app.view.find_ground(*ray)) is not None:
            self.move(index, point)
