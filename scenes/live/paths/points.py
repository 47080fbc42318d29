"""Points of a path on the ground, and the smooth curve through them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import KDTree

from mapctl import curves
from mapctl.curves.curve import Curve
from mapctl.errors import RequestError
from mapctl.mesh.primitives import Array

MAX_POINTS = 200
"""Largest number of points that can be dragged."""
MAX_DISTANCE = 1000.0
"""Farthest that a point can be from the origin along x or z, metres."""
MAX_LENGTH = 5000.0
"""Longest path, metres."""
_SPACING = 0.05  # metres between the places of the curve as it is shown and written, or more where it is long
_MAX_SHOWN = 1500
_COUNTS = (4, 8, 12, 16, 24, 32, 48, 64, 96, 128, MAX_POINTS)  # points that are tried for a curve of more
_TOLERANCE = 0.02  # metres that a curve may be off for fewer points
_FEW = 24  # points that are taken as they are

Point = tuple[float, float]


@dataclass
class PathPoints:
    """A path that is edited: points (x, z) in metres, of which one may be selected."""

    points: list[Point] = field(default_factory=list)
    """The points in order."""
    is_closed: bool = False
    """Whether the last is followed by the first."""
    selected: int | None = None
    """Index of the selected point."""

    def add(self, x: float, z: float) -> None:
        """Add one more point at the end, and select it. RequestError where it cannot be."""
        self._put([*self.points, (x, z)])
        self.selected = len(self.points) - 1

    def move(self, index: int, x: float, z: float) -> None:
        """Move a point; one that is not there any more changes nothing. RequestError where it cannot be."""
        if 0 <= index < len(self.points):
            self._put([*self.points[:index], (x, z), *self.points[index + 1 :]])
            self.selected = index

    def insert(self, after: int, x: float, z: float) -> None:
        """Insert a point after another, and select it. RequestError where it cannot be."""
        if 0 <= after < len(self.points):
            self._put([*self.points[: after + 1], (x, z), *self.points[after + 1 :]])
            self.selected = after + 1

    def remove(self, index: int | None) -> None:
        """Remove a point, and select the one before it. RequestError where there is none."""
        if index is None or not 0 <= index < len(self.points):
            raise RequestError("no point is selected: click on one")
        del self.points[index]
        self.selected = max(0, index - 1) if self.points else None

    def select(self, index: int) -> None:
        """Select a point; one that is not there any more changes nothing."""
        if 0 <= index < len(self.points):
            self.selected = index

    def close(self, closed: bool) -> None:
        """Close the path to a loop, or open it."""
        self.is_closed = closed

    def clear(self) -> None:
        """Remove all points."""
        self.points, self.is_closed, self.selected = [], False, None

    def replace(self, points: Sequence[Point], *, closed: bool) -> None:
        """Take other points. RequestError where they make no path; then nothing changes."""
        check_points(points)
        make_curve(points, closed=closed)
        self.points, self.is_closed, self.selected = list(points), closed, None

    def midpoints(self) -> list[Point]:
        """Return a place on the curve between each point and the next: where a point can be inserted after it."""
        curve = self.curve
        if curve is None or len(self.points) < 2:
            return []
        arcs = _find_arcs(curve, self.points)
        ends = np.r_[arcs[1:], curve.length] if self.is_closed else arcs[1:]
        places = _sample(curve, (arcs[: len(ends)] + ends) / 2)
        return [(float(x), float(z)) for x, z in places]

    @property
    def curve(self) -> Curve | None:
        """Smooth curve through the points; None while they make none."""
        try:
            return make_curve(self.points, closed=self.is_closed)
        except RequestError:
            return None

    def _put(self, points: list[Point]) -> None:
        check_points(points)
        self.points = points


def check_points(points: Sequence[Point]) -> None:
    """Check number and place of points; RequestError says which is wrong, and what is allowed."""
    if len(points) > MAX_POINTS:
        raise RequestError(f"a path that can be edited has at most {MAX_POINTS} points, not {len(points)}")
    for number, point in enumerate(points, start=1):
        if not all(math.isfinite(value) and abs(value) <= MAX_DISTANCE for value in point):
            where = ", ".join(f"{value:.6g}" for value in point)
            raise RequestError(
                f"point {number} of the path is at ({where}) m; allowed is up to {MAX_DISTANCE:g} m from the origin"
            )


def make_curve(points: Sequence[Point], *, closed: bool) -> Curve:
    """Make the smooth curve through points; RequestError where they make none, or a very long one."""
    if len(points) < 2:
        raise RequestError(f"a path needs 2 points or more, and has {len(points)}")
    curve = curves.through(np.array(points, dtype=np.float64), closed=closed)
    if curve.length > MAX_LENGTH:
        raise RequestError(f"the path is {curve.length:.0f} m long; allowed are {MAX_LENGTH:g} m")
    return curve


def sample_curve(curve: Curve) -> Array:
    """Sample a curve (n, 2) for showing and writing: every 5 cm, or less often where it is long."""
    count = min(_MAX_SHOWN, max(2, round(curve.length / _SPACING) + 1))
    places = _sample(curve, np.linspace(0, curve.length, count))
    if curve.closed:
        places[-1] = places[0]
    return places


def choose_points(curve: Curve, given: Array) -> tuple[list[Point], str]:
    """Choose points that can be dragged for a curve that was read from `given` points (n, 2).

    A few are taken as they are. For more, the fewest points at equal distances are taken whose curve is off by at most
    2 cm, or else as many as there can be. Returns them, and a sentence where they are not the ones given.
    """
    whole = _open(given, closed=curve.closed)
    if len(whole) <= _FEW:
        return whole, ""
    places = _sample(curve, np.linspace(0, curve.length, 4 * _MAX_SHOWN))
    points, off = whole, math.inf
    for count in _COUNTS:
        arcs = np.linspace(0, curve.length, count, endpoint=not curve.closed)
        points = [(float(x), float(z)) for x, z in _sample(curve, arcs)]
        off = float(KDTree(make_curve(points, closed=curve.closed).points.numpy()).query(places)[0].max())
        if off <= _TOLERANCE:
            break
    if len(whole) <= len(points):
        return whole, ""
    return points, f"{len(whole)} points became {len(points)} that can be dragged; the curve is at most {_say(off)} off"


def _say(metres: float) -> str:
    return f"{100 * metres:.1f} cm" if metres < 1 else f"{metres:.1f} m"


def _open(given: Array, *, closed: bool) -> list[Point]:
    """Return the points without the last where it repeats the first of a closed curve."""
    points = [(float(x), float(z)) for x, z in given]
    return points[:-1] if closed and len(points) > 3 and math.dist(points[0], points[-1]) < 1e-3 else points


def _find_arcs(curve: Curve, points: Sequence[Point]) -> Array:
    """Find the arcs at which a curve passes its points, in order: each is the nearest place after the one before."""
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
