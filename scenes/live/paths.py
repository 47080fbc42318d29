"""Paths on the ground: points that are drawn and dragged, the curve through them, and files of it."""

import math
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import trimesh
import viser
from scipy.spatial import KDTree

from mapctl import curves
from mapctl.curves import files
from mapctl.curves.curve import Curve
from mapctl.errors import FileFormatError, MapctlError, RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.live.ground import to_rgb_bytes

ENDINGS = (".csv", ".tsv", ".txt", ".svg")
"""Endings of files that are read."""
MAX_POINTS = 200
"""Largest number of points that can be dragged."""
HELP = "Drag a ball to move it, a small one to insert a point there; Ctrl and a click removes one."
_MAX_DISTANCE, _MAX_LENGTH = 1000.0, 5000.0  # metres of a point from the origin along x or z, and of a path
_MAX_BYTES = 8 * 2**20  # of a file that a browser sends
_SPACING, _MAX_SAMPLES = 0.05, 1500  # metres between samples of the curve, or more where it is long
_COUNTS = (4, 8, 12, 16, 24, 32, 48, 64, 96, 128, MAX_POINTS)  # of points that are tried for a curve of more
_TOLERANCE = 0.02  # metres that a curve may be off for fewer points
_FEW = 24  # points that are taken as they are
_LINE_HEIGHT, _BALL_HEIGHT = 0.02, 0.03  # metres over the ground
_BALL_RADIUS, _FIRST_SCALE, _BETWEEN_SCALE = 0.075, 1.35, 0.6  # the first point's ball is larger than the others

Point = tuple[float, float]
Ray = tuple[Any, Any]
"""Origin and direction, three numbers each, as a browser sent them."""


@dataclass
class PathPoints:
    """A path that is edited: points (x, z) in metres. Points whose index is gone change nothing."""

    points: list[Point] = field(default_factory=list)
    """The points in order."""
    is_closed: bool = False
    """Whether the last is followed by the first."""

    def add(self, x: float, z: float) -> None:
        """Add a point at the end. RequestError where it cannot be."""
        self.insert(len(self.points) - 1, x, z)

    def insert(self, after: int, x: float, z: float) -> None:
        """Insert a point after another. RequestError where it cannot be."""
        if after < len(self.points):
            self._put([*self.points[: after + 1], (x, z), *self.points[after + 1 :]])

    def move(self, index: int, x: float, z: float) -> None:
        """Move a point. RequestError where it cannot be."""
        if index < len(self.points):
            self._put([*self.points[:index], (x, z), *self.points[index + 1 :]])

    def remove(self, index: int) -> None:
        """Remove a point."""
        del self.points[index : index + 1]

    def replace(self, points: Sequence[Point], *, closed: bool) -> None:
        """Take other points. RequestError where they make no path; then nothing changes."""
        make_curve(points, closed=closed)
        self._put(list(points))
        self.is_closed = closed

    @property
    def curve(self) -> Curve | None:
        """Smooth curve through the points; None while they make none."""
        with suppress(RequestError):
            return make_curve(self.points, closed=self.is_closed)
        return None

    def midpoints(self) -> list[Point]:
        """Return a point of the curve between each point and the next: where one can be inserted after it."""
        curve = self.curve
        if curve is None:
            return []
        arcs = _find_arcs(curve, self.points)
        ends = np.r_[arcs[1:], curve.length] if self.is_closed else arcs[1:]
        return [(float(x), float(z)) for x, z in _sample(curve, (arcs[: len(ends)] + ends) / 2)]

    def _put(self, points: list[Point]) -> None:
        if len(points) > MAX_POINTS:
            raise RequestError(f"a path has at most {MAX_POINTS} points, not {len(points)}")
        for number, point in enumerate(points, start=1):
            if not all(math.isfinite(value) and abs(value) <= _MAX_DISTANCE for value in point):
                where = ", ".join(f"{value:.6g}" for value in point)
                raise RequestError(
                    f"point {number} of the path is at ({where}) m, more than {_MAX_DISTANCE:g} m from the origin"
                )
        self.points = points


def make_curve(points: Sequence[Point], *, closed: bool) -> Curve:
    """Make the smooth curve through points; RequestError where they make none, or a very long one."""
    if len(points) < 2:
        raise RequestError(f"a path needs 2 points or more, and has {len(points)}")
    curve = curves.through(np.array(points, dtype=np.float64), closed=closed)
    if curve.length > _MAX_LENGTH:
        raise RequestError(f"the path is {curve.length:.0f} m long; allowed are {_MAX_LENGTH:g} m")
    return curve


def sample_curve(curve: Curve) -> Array:
    """Sample a curve (n, 2) every 5 cm, or less often where it is long."""
    count = min(_MAX_SAMPLES, max(2, round(curve.length / _SPACING) + 1))
    samples = _sample(curve, np.linspace(0, curve.length, count))
    if curve.closed:
        samples[-1] = samples[0]
    return samples


def write_csv(curve: Curve) -> bytes:
    """Write a curve as a table of x and z in metres, as `mapctl follow` reads it; a closed one ends where it begins."""
    rows = "\n".join(f"{x:.4f},{z:.4f}" for x, z in sample_curve(curve))
    return f"x,z\n{rows}\n".encode()


def read_path(name: str, content: bytes) -> tuple[PathPoints, str]:
    """Read a table or drawing that a browser sent as a file of this name; also return a note where its many points
    became fewer. MapctlError names the fault, without this machine's paths."""
    if len(content) > _MAX_BYTES:
        raise RequestError(f"the file has {len(content) / 2**20:.0f} MiB; a path has at most {_MAX_BYTES // 2**20}")
    ending = PurePosixPath(name).suffix.lower()
    if ending not in ENDINGS:
        raise RequestError(f"a path is read from {', '.join(ENDINGS)} files, not from {name[-60:]!r}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"path{ending}"
        file.write_bytes(content)
        try:
            given = files.read_svg(file) if ending == ".svg" else files.read_csv(file)
            curve = curves.from_points(given[:, [0, -1]])
        except FileFormatError as error:
            raise RequestError(str(error).replace(str(file), name[-60:])) from None
    points, note = choose_points(curve, given[:, [0, -1]])
    path = PathPoints()
    path.replace(points, closed=curve.closed)
    return path, note


def choose_points(curve: Curve, given: Array) -> tuple[list[Point], str]:
    """Choose points that can be dragged for a curve that was read from `given` points (n, 2), and a note where they
    are others: the fewest at equal distances whose curve is off by at most 2 cm, or else as many as there can be."""
    whole = [(float(x), float(z)) for x, z in given]
    if curve.closed and len(whole) > 3 and math.dist(whole[0], whole[-1]) < 1e-3:
        del whole[-1]
    if len(whole) <= _FEW:
        return whole, ""
    samples = _sample(curve, np.linspace(0, curve.length, 4 * _MAX_SAMPLES))
    points, off = whole, math.inf
    for count in _COUNTS:
        arcs = np.linspace(0, curve.length, count, endpoint=not curve.closed)
        points = [(float(x), float(z)) for x, z in _sample(curve, arcs)]
        off = float(KDTree(make_curve(points, closed=curve.closed).points.numpy()).query(samples)[0].max())
        if off <= _TOLERANCE:
            break
    if len(whole) <= len(points):
        return whole, ""
    return points, f"{len(whole)} points became {len(points)}; the curve is at most {100 * off:.1f} cm off."


def _find_arcs(curve: Curve, points: Sequence[Point]) -> Array:
    """Find the arc lengths at which a curve passes its points, in order: each is the nearest after the one before."""
    vertices, arcs, start = curve.points.numpy(), [], 0
    lengths = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(vertices, axis=0), axis=1))]
    for number, point in enumerate(points):
        apart = np.linalg.norm(vertices[start:] - np.array(point), axis=1)
        near = np.flatnonzero(apart <= apart.min() + 1e-2) if number else np.array([0])
        start += int(near[0] + apart[near[0] : near[0] + 3].argmin()) if number else 0
        arcs.append(lengths[start])
    return np.array(arcs)


def _sample(curve: Curve, arcs: Array) -> Array:
    vertices = curve.points.numpy()
    lengths = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(vertices, axis=0), axis=1))]
    return np.stack([np.interp(arcs, lengths, axis) for axis in vertices[:, [0, -1]].T], axis=1)


class PathEditor:
    """The path in all browsers: a line, balls at its points, and small ones between them that become points.

    Its methods are for the loop's thread; `enqueue` runs there what browsers drag and click.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        world: str,
        *,
        locate: Callable[[Ray], Point | None],
        enqueue: Callable[[Callable[[], None]], None],
        on_change: Callable[[str], None],
    ):
        """Add the path below the node `world`. `locate` returns where a ray meets the ground; `on_change` is given a
        note after each change."""
        self.path = PathPoints()
        self._scene, self._name, self._locate, self._enqueue = scene, f"{world}/path", locate, enqueue
        self._on_change = on_change
        self._line: viser.LineSegmentsHandle | None = None
        self._points = _Balls(scene, f"{self._name}/points", self._drag, self._click)
        self._between = _Balls(scene, f"{self._name}/between", self._insert, None)
        self._inserted: int | None = None  # index of the point that became one by the drag that goes on
        self._is_stale, self._note = False, ""

    def edit(self, action: Callable[[], str | None]) -> None:
        """Change the path; the note, or what cannot be done, goes to `on_change`."""
        try:
            self._note = action() or ""
        except MapctlError as error:
            self._note = f"⚠️ {error}"
        if not self._is_stale:  # a drag is many changes, shown once
            self._is_stale = True
            self._enqueue(self._show)

    def add(self, x: float, z: float, ray: Array) -> None:
        """Add a point at the end, unless the click's ray (2, 3) meets a ball: browsers report that click here too."""
        if not hits_ball(self.path.points, ray):
            self.edit(lambda: self.path.add(x, z))

    def close(self, closed: bool) -> None:
        """Close the path to a loop, or open it."""
        self.path.is_closed = closed
        self.edit(lambda: None)

    def clear(self) -> None:
        """Remove all points."""
        self.path = PathPoints()
        self.edit(lambda: None)

    def load(self, name: str, content: bytes) -> None:
        """Take the path of a file that a browser sent."""

        def loaded() -> str:
            self.path, note = read_path(name, content)
            return note

        self.edit(loaded)

    def describe(self) -> str:
        """Describe the path in a line."""
        if not self.path.points:
            return HELP
        count, curve = len(self.path.points), self.path.curve
        return f"{count} point{'s' * (count != 1)}{'' if curve is None else f', {curve.length:.1f} m'}."

    def _drag(self, index: int, phase: str, ray: Ray) -> None:
        def dragged() -> None:
            if phase != "end" and (point := self._locate(ray)) is not None:
                self.path.move(index, *point)

        self._enqueue(lambda: self.edit(dragged))

    def _insert(self, index: int, phase: str, ray: Ray) -> None:
        def dragged() -> None:
            point = self._locate(ray)
            if phase == "start" and point is not None:
                self._inserted = None  # also where the point cannot be
                self.path.insert(index, *point)
                self._inserted = index + 1
            elif phase == "update" and point is not None and self._inserted is not None:
                self.path.move(self._inserted, *point)
            elif phase == "end":
                self._inserted = None

        self._enqueue(lambda: self.edit(dragged))

    def _click(self, index: int) -> None:
        self._enqueue(lambda: self.edit(lambda: self.path.remove(index)))

    def _show(self) -> None:
        self._is_stale = False
        points, midpoints = self.path.points, self.path.midpoints()
        self._points.show(points, colours.TARGET, [_FIRST_SCALE] + [1.0] * (len(points) - 1))
        if self._inserted is None:  # they stay as they are while one of them is dragged
            self._between.show(midpoints, colours.TRAIL, [_BETWEEN_SCALE] * len(midpoints))
        if self._line is not None:
            self._line.remove()
            self._line = None
        if (curve := self.path.curve) is not None:
            line = np.insert(sample_curve(curve), 1, _LINE_HEIGHT, axis=1).astype(np.float32)
            self._line = self._scene.add_line_segments(
                f"{self._name}/line",
                np.stack([line[:-1], line[1:]], axis=1),
                to_rgb_bytes(colours.TARGET),
                thickness=0.025,
            )
        self._on_change(self._note)


class _Balls:
    """Balls that are one node: it is added anew where their number changes, and else moved."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        drag: Callable[[int, str, Ray], None],
        click: Callable[[int], None] | None,
    ):
        """`drag` is given the index of what is dragged, the phase (`start`, `update`, `end`) and the mouse's ray;
        `click` the index of what was clicked with Ctrl."""
        self._scene, self._name, self._drag, self._click = scene, name, drag, click
        self.handle: viser.BatchedMeshHandle | None = None
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_BALL_RADIUS)
        self._vertices, self._faces = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.uint32)

    def show(self, points: Sequence[Point], colour: str, scales: Sequence[float]) -> None:
        positions = np.insert(np.array(points, np.float32).reshape(-1, 2), 1, _BALL_HEIGHT, axis=1)
        if self.handle is not None and len(self.handle.batched_positions) == len(points):
            self.handle.batched_positions = positions
            return
        if self.handle is not None:
            self.handle.remove()
            self.handle = None
        if not points:
            return
        self.handle = self._scene.add_batched_meshes_simple(
            self._name,
            self._vertices,
            self._faces,
            np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(points), 1)),
            positions,
            batched_scales=np.array(scales, np.float32),
            batched_colors=np.tile(np.array(to_rgb_bytes(colour), np.uint8), (len(points), 1)),
            lod="off",
            cast_shadow=False,
        )

        # Coroutines run in the order in which browsers did things; functions run on threads in any order.
        @self.handle.on_drag("left")
        async def _(event: viser.SceneNodeDragEvent) -> None:
            if event.instance_index is not None:
                origin = np.asarray(event.client.camera.position)
                self._drag(event.instance_index, event.phase, (origin, np.asarray(event.end_position) - origin))

        if self._click is not None:
            click = self._click

            @self.handle.on_click(modifier="cmd/ctrl")
            async def _(event: viser.SceneNodePointerEvent) -> None:
                if event.instance_index is not None:
                    click(event.instance_index)


def hits_ball(points: Sequence[Point], ray: Array) -> bool:
    """Return whether a ray (origin and direction, (2, 3), metres) meets a ball of these points."""
    if not points:
        return False
    origin, direction = ray[0], ray[1] / max(1e-9, float(np.linalg.norm(ray[1])))
    apart = np.insert(np.array(points), 1, _BALL_HEIGHT, axis=1) - origin
    along = apart @ direction
    radius = _BALL_RADIUS * np.r_[_FIRST_SCALE, np.ones(len(points) - 1)]
    return bool(((np.linalg.norm(apart - along[:, None] * direction, axis=1) <= radius) & (along > 0)).any())
