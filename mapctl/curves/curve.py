"""The curve a character follows: a polyline on the ground (x, z) or in space (x, y, z), by arc length.

Positive turns, offsets and curvatures are to the left: +Z turns toward +X, as headings do everywhere.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.rotations import unwrap_angle

SPACING = 0.01
"""Metres between the vertices of a curve, about."""
TANGENT_BASE = 0.05
"""Metres of the chord that gives a tangent: longer than the jitter of a drawing, shorter than a stride."""
MIN_LENGTH, MAX_LENGTH = 0.01, 100_000.0
"""Least and greatest length of a curve, metres."""
MAX_POINTS = 1_000_000
"""Largest number of points that a curve may be given with, and has."""

_COINCIDENT = 1e-6  # metres; nearer neighbours are one point
_CLOSED_GAP = 1e-3  # metres; ends nearer than this meet


def build_dense_polyline(
    points: ndarray | Tensor, closed: bool | None = None
) -> tuple[Float[Tensor, "dense dims"], bool]:
    """Build the polyline through `points` (n, 2 or 3; metres), vertices about 1 cm apart, and whether it is closed.

    Straight pieces are divided evenly; of points denser than 1 cm the one that bends the curve most is kept in each
    centimetre. Closed where `closed` is true, or by default where the ends lie within 1 mm, or half the points' usual
    spacing, of each other; a closed polyline repeats its first point at the end. Raises RequestError with the reason
    where points make no curve.
    """
    given = _check_points(points)
    distinct = given[np.r_[True, _span_lengths(given) > _COINCIDENT]]
    if len(distinct) < 2:
        raise RequestError("a curve needs at least 2 distinct points, got 1")
    gap = np.linalg.norm(distinct[-1] - distinct[0])
    if closed is None:
        closed = len(distinct) > 2 and bool(gap <= max(_CLOSED_GAP, 0.5 * np.median(_span_lengths(distinct))))
    if closed:  # the first point again, exactly
        distinct = np.concatenate([distinct[:-1] if gap <= _CLOSED_GAP else distinct, distinct[:1]])
    length = _span_lengths(distinct).sum()
    if not MIN_LENGTH <= length <= MAX_LENGTH:
        raise RequestError(f"the curve is {length:.6g} m long, allowed are {MIN_LENGTH:g} to {MAX_LENGTH:g} m")
    spacing = max(SPACING, length / MAX_POINTS)
    return torch.from_numpy(_subdivide(_thin_points(distinct, spacing), spacing)), closed


def _check_points(points: ndarray | Tensor) -> Float[ndarray, "points dims"]:
    given = np.asarray(points, dtype=np.float64)
    if given.ndim != 2 or given.shape[1] not in (2, 3):
        raise RequestError(f"a curve's points have the shape (n, 2) or (n, 3), got {given.shape}")
    if not 2 <= len(given) <= MAX_POINTS:
        raise RequestError(f"a curve needs 2 to {MAX_POINTS} points, got {len(given)}")
    wrong = ~(np.abs(given) <= MAX_LENGTH).all(axis=1)  # catches NaN as well
    if wrong.any():
        first = int(wrong.argmax())
        locate = ", ".join(f"{value:g}" for value in given[first])
        raise RequestError(f"point {first} of the curve is ({locate}), expected numbers up to {MAX_LENGTH:g} m")
    return given


def _span_lengths(points: ndarray) -> ndarray:
    return np.linalg.norm(np.diff(points, axis=0), axis=1)


def _thin_points(points: ndarray, spacing: float) -> ndarray:
    """Keep both ends, and of the points in each piece of `spacing` metres the one farthest from its chord."""
    arcs = np.r_[0.0, np.cumsum(_span_lengths(points))]

    def locate(at: ndarray) -> ndarray:
        return np.stack([np.interp(at, arcs, axis) for axis in points.T], axis=1)

    bend = np.linalg.norm(points - (locate(arcs - spacing) + locate(arcs + spacing)) / 2, axis=1)
    bend[[0, -1]] = np.inf
    # The last point has a piece of its own, or it might be dropped in favour of the first.
    piece = np.r_[(arcs[:-1] / spacing).astype(np.int64), np.iinfo(np.int64).max]
    order = np.lexsort((-bend, piece))
    best = order[np.r_[True, np.diff(piece[order]) > 0]]
    return points[np.sort(best)]


def _subdivide(points: ndarray, spacing: float) -> ndarray:
    """Cut every straight piece into equal parts of at most `spacing` metres."""
    parts = np.maximum(1, np.ceil(_span_lengths(points) / spacing - 1e-9)).astype(np.int64)
    piece = np.repeat(np.arange(len(parts)), parts)
    step = np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)
    inner = points[piece] + (step / parts[piece])[:, None] * np.diff(points, axis=0)[piece]
    return np.concatenate([inner, points[-1:]])


Arc = Float[Tensor, "*batch"] | float

_NEIGHBOURS = 16  # vertices looked at around a point: enough to hold an end of the nearest segment (1 cm apart)
_SEARCH_STEP = 0.04  # metres between the arcs that a local search tries first
_REFINEMENT = 10  # a local search's second grid is this much finer
_END_EXTENSION = 1.0  # metres of straight extension in the tables; beyond them the line goes on all the same


@dataclass(frozen=True, eq=False, repr=False)
class Curve:
    """A dense polyline. Build one with `curves.from_points`, `curves.read` or a shape function.

    Arcs are metres along the curve, tensors of any shape or floats. They wrap on a closed curve; beyond the
    ends of an open one the curve goes on straight. Results have the arcs' dtype and follow their gradients.
    """

    points: Float[Tensor, "points dims"]
    """Vertices about 1 cm apart, float64, metres: (x, z) or (x, y, z). A closed curve ends with its first."""
    closed: bool = False
    """Whether the curve ends where it starts, so that arcs wrap."""

    def __str__(self) -> str:
        kind = "closed" if self.closed else "open"
        where = "on the ground" if self.dims == 2 else "in space"
        start = ", ".join(f"{float(value):.2f}" for value in self.start)
        return f"Curve: {kind}, {where}, {self.length:.2f} m from ({start})"

    def __repr__(self) -> str:
        return f"<{self}>"

    @cached_property
    def _arcs(self) -> Float[Tensor, "points"]:
        """Arc of every vertex, metres."""
        return torch.cat([self.points.new_zeros(1), self.points.diff(dim=0).norm(dim=-1).cumsum(0)])

    @cached_property
    def _tables(self) -> tuple[Tensor, Tensor, Tensor]:
        """Arcs of the knots, knots, unit direction after each: the vertices, and a piece beyond open ends."""
        arcs, points = self._arcs, self.points
        if not self.closed:
            base = min(TANGENT_BASE, self.length / 2)
            inside = torch.searchsorted(arcs, arcs.new_tensor([base, self.length - base])).tolist()
            ahead, behind = max(1, inside[0]), min(len(points) - 2, inside[1])
            before = points[0] - _END_EXTENSION * _normalise(points[ahead] - points[0])
            beyond = points[-1] + _END_EXTENSION * _normalise(points[-1] - points[behind])
            points = torch.cat([before[None], points, beyond[None]])
            arcs = torch.cat([arcs[:1] - _END_EXTENSION, arcs, arcs[-1:] + _END_EXTENSION])
        return arcs, points, points.diff(dim=0) / arcs.diff().unsqueeze(-1)

    @cached_property
    def length(self) -> float:
        """Metres from end to end, or once around."""
        return float(self._arcs[-1])

    @property
    def dims(self) -> int:
        """Number of coordinates: 2 on the ground, 3 in space."""
        return self.points.shape[-1]

    @property
    def ground_axes(self) -> slice:
        """Where x and z are in a point or a direction of the curve."""
        return slice(None, None, self.dims - 1)

    @property
    def start(self) -> Float[Tensor, "dims"]:
        """The first point, metres."""
        return self.points[0]

    @cached_property
    def start_heading(self) -> float:
        """Direction of travel at the start, radians: 0 is +Z, +pi/2 is +X; only what lies ahead counts."""
        # Chords centred a little ahead see only what follows; extrapolating is exact on circular arcs.
        ahead = self._half_base * torch.tensor([1.0, 2.0], dtype=torch.float64)
        near, far = unwrap_angle(self.heading(ahead)).tolist()
        return math.remainder(2 * near - far, 2 * math.pi)

    @property
    def _half_base(self) -> float:
        return min(TANGENT_BASE, self.length / 8) / 2

    def _segment(self, arc: Tensor) -> tuple[Tensor, Int[Tensor, "*batch"]]:
        """Return the arc within the tables, float64, and the segment it lies on."""
        arc = torch.remainder(arc.double(), self.length) if self.closed else arc.double()
        return arc, _find_segment(self._tables[0], arc)

    def _point_at(self, arc: Tensor) -> Tensor:
        knots, points, directions = self._tables
        arc, segment = self._segment(arc)
        return points[segment] + (arc - knots[segment]).unsqueeze(-1) * directions[segment]

    def point(self, arc: Arc) -> Float[Tensor, "*batch dims"]:
        """Return the position on the curve at an arc, metres."""
        arc = _to_tensor(arc)
        return self._point_at(arc).to(arc.dtype)

    def ground_point(self, arc: Arc) -> Float[Tensor, "*batch 2"]:
        """Return the position over the ground (x, z) at an arc, metres."""
        return self.point(arc)[..., self.ground_axes]

    def tangent(self, arc: Arc) -> Float[Tensor, "*batch dims"]:
        """Return the unit direction of travel: a chord of 5 cm, so that the jitter of a drawing does not flip it."""
        arc = _to_tensor(arc)
        chord = self._point_at(arc.double() + self._half_base) - self._point_at(arc.double() - self._half_base)
        # Where a curve turns back on itself the chord vanishes; the segment still has a direction.
        gone = chord.detach().norm(dim=-1, keepdim=True) < 1e-6
        chord = torch.where(gone, self._tables[2][self._segment(arc)[1]], chord)
        return _normalise(chord).to(arc.dtype)

    def heading(self, arc: Arc) -> Float[Tensor, "*batch"]:
        """Return the direction of travel over the ground, radians in -pi to pi: 0 is +Z, +pi/2 is +X."""
        tangent = self.tangent(arc)
        return torch.atan2(tangent[..., 0], tangent[..., -1])

    def left(self, arc: Arc) -> Float[Tensor, "*batch 2"]:
        """Return the unit ground vector (x, z) to the left of travel."""
        tangent = self.tangent(arc)
        across = torch.stack([tangent[..., -1], -tangent[..., 0]], dim=-1)
        return across / across.norm(dim=-1, keepdim=True).clamp_min(1e-9)

    @cached_property
    def _vertex_heading(self) -> tuple[Tensor, Tensor]:
        """Unwrapped heading at every vertex, and its slope to the next."""
        heading = unwrap_angle(self.heading(self._arcs))
        return heading, heading.diff() / self._arcs.diff()

    def _heading_at(self, arc: Tensor) -> Tensor:
        heading, slope = self._vertex_heading
        laps = torch.floor(arc.detach() / self.length) if self.closed else torch.zeros_like(arc)
        within = torch.remainder(arc, self.length) if self.closed else arc.clamp(0, self.length)
        vertex = _find_segment(self._arcs, within)
        return heading[vertex] + (within - self._arcs[vertex]) * slope[vertex] + laps * (heading[-1] - heading[0])

    def curvature(self, arc: Arc, *, base: float = 0.3) -> Float[Tensor, "*batch"]:
        """Turn of the heading per metre, 1/m, over `base` metres around the arc; left is positive.

        The base spans a few vertices of a coarse drawing, whose heading changes at vertices only, and gives a
        sharp corner the finite curvature that a stride through it has.
        """
        arc = _to_tensor(arc)
        ahead, behind = self._heading_at(arc.double() + base / 2), self._heading_at(arc.double() - base / 2)
        return ((ahead - behind) / base).to(arc.dtype)

    def to_curve_axes(self, points_world: Float[Tensor, "*batch axes"]) -> Float[Tensor, "*batch dims"]:
        """Return points along the curve's own axes: world points lose their height for a curve on the ground."""
        return points_world[..., ::2] if points_world.shape[-1] > self.dims else points_world

    def nearest(
        self, points_world: Float[Tensor, "*batch axes"], around: Arc | None = None, *, reach: float = 0.5
    ) -> Float[Tensor, "*batch"]:
        """Find the arc of the point nearest to each given one: (x, y, z), or (x, z) for a curve on the ground.

        With `around`, only arcs within `reach` metres of it are searched, so that a curve that crosses itself is not
        left for its other branch; the result is not wrapped (it stays near `around`) and may lie beyond the ends.
        Without, the whole curve is searched between its ends. Differentiable in the points.
        """
        points = self.to_curve_axes(points_world)
        if around is None:
            return self._nearest_anywhere(points)
        with torch.no_grad():
            step = min(_SEARCH_STEP, reach / 4)
            guess = self._search_closest(points, _to_tensor(around).double().expand(points.shape[:-1]), reach, step)
            guess = self._search_closest(points, guess, step, step / _REFINEMENT)
            within, segment = self._segment(guess)
        segments = segment.unsqueeze(-1) + torch.tensor([-1, 0, 1])
        return (guess + self._project(points, segments, within)).to(points.dtype)

    def _project(self, points: Tensor, segments: Int[Tensor, "*batch tried"], within: Tensor | float) -> Tensor:
        """Return metres from the arc `within` to the nearest position on the best of each point's segments."""
        knots, corners, directions = self._tables
        last = len(directions) - 1
        segments = segments % (last + 1) if self.closed else segments.clamp(0, last)
        along = ((points.unsqueeze(-2) - corners[segments]) * directions[segments]).sum(-1)
        stop = knots[segments + 1] - knots[segments]
        if self.closed:
            along = along.clamp_min(0).minimum(stop)
        else:  # the pieces beyond the ends have no end
            along = torch.where(segments == 0, along, along.clamp_min(0))
            along = torch.where(segments == last, along, along.minimum(stop))
        apart = corners[segments] + along.unsqueeze(-1) * directions[segments] - points.unsqueeze(-2)
        best = apart.detach().square().sum(-1).argmin(-1, keepdim=True)
        step = (knots[segments] + along).gather(-1, best).squeeze(-1) - within
        return torch.remainder(step + self.length / 2, self.length) - self.length / 2 if self.closed else step

    def _search_closest(self, points: Tensor, around: Tensor, reach: float, step: float) -> Tensor:
        """Find the closest to each point among the arcs `around` - reach ... + reach, `step` apart."""
        count = math.ceil(reach / step)
        arcs = around.unsqueeze(-1) + torch.arange(-count, count + 1, dtype=torch.float64) * (reach / count)
        best = (self._point_at(arcs) - points.unsqueeze(-2)).square().sum(-1).argmin(-1, keepdim=True)
        return arcs.gather(-1, best).squeeze(-1)

    @cached_property
    def _tree(self) -> "scipy.spatial.KDTree":
        return scipy.spatial.KDTree(self.points.numpy())

    def _nearest_anywhere(self, points: Tensor) -> Tensor:
        count = len(self.points)
        vertices = self._tree.query(points.detach().double().numpy(), k=min(_NEIGHBOURS, count))[1]
        vertices = torch.as_tensor(vertices, dtype=torch.long)
        segments = torch.cat([vertices - 1, vertices], dim=-1).clamp(0, count - 2)
        arc = self._project(points, segments if self.closed else segments + 1, 0.0)
        arc = torch.remainder(arc, self.length) if self.closed else arc
        return arc.to(points.dtype)

    def signed_offset(self, points_world: Float[Tensor, "*batch axes"], arc: Arc) -> Float[Tensor, "*batch"]:
        """Return metres from the curve's position at `arc` to each point, sideways on the ground; left is positive."""
        apart = self.to_curve_axes(points_world) - self.point(arc)
        return (apart[..., self.ground_axes] * self.left(arc)).sum(-1)


def _to_tensor(arc: Arc) -> Tensor:
    return arc if torch.is_tensor(arc) else torch.tensor(arc, dtype=torch.float64)


def _find_segment(knots: Tensor, arc: Tensor) -> Int[Tensor, "*batch"]:
    """Find the index of the knot before each arc; the first or the last but one for arcs outside."""
    return torch.searchsorted(knots, arc.detach().contiguous(), right=True).sub(1).clamp(0, len(knots) - 2)


def _normalise(vector: Tensor) -> Tensor:
    return vector / vector.norm(dim=-1, keepdim=True).clamp_min(1e-12)
