"""Where a character is to go, where it plans to, and where it came from, as flat bands on the ground."""

from collections import deque

import numpy as np
import viser

from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.live.ground import to_rgb_bytes

_PAST_SECONDS, _POINTS = 4.0, 24  # of the trail behind; points of every band
_PAST_HEIGHT, _PLAN_HEIGHT, _WISH_HEIGHT = 0.006, 0.010, 0.014  # metres over the ground, so that none flickers
_PAST_WIDTH, _PLAN_WIDTH, _WISH_WIDTH = 0.035, 0.06, 0.075
_HEAD_METRES, _HEAD_WIDTH = 0.20, 2.6  # length of an arrow's head, and its width over the shaft's
_FAR = 1e4  # metres of the corners before anything is shown, so that a browser never takes a band for out of sight
_SLOWEST = 0.12  # m/s and metres, below which there is no way to show


class Tracks:
    """Three bands of one character: the wish red, plan and past yellow."""

    def __init__(self, scene: viser.SceneApi, name: str):
        """Add the bands below a node, hidden until there is something to show."""
        self._node = scene.add_frame(name, show_axes=False)
        # A browser that is busy sets places sooner than shapes, so what lies ahead goes with its node.
        self._ahead = scene.add_frame(f"{name}/ahead", show_axes=False)
        faces = _list_faces()
        self._wish, self._plan, self._past = (
            scene.add_mesh_simple(
                f"{name}/{what}",
                np.linspace(-_FAR, _FAR, 2 * _POINTS)[:, None].repeat(3, axis=1).astype(np.float32),
                faces,
                color=to_rgb_bytes(colour),
                side="double",
                cast_shadow=False,
                visible=False,
            )
            for what, colour in (("ahead/wish", colours.TARGET), ("ahead/plan", colours.TRAIL), ("past", colours.TRAIL))
        )
        self._places: deque[tuple[float, Array]] = deque()
        self._present: tuple[Array, tuple[float, float], Array, Array] | None = None

    def show(self, visible: bool) -> None:
        """Show or hide all of it."""
        self._node.visible = visible

    def forget(self) -> None:
        """Forget where it came from."""
        self._places.clear()
        self._present = None

    def are_behind(self, seconds: float) -> bool:
        """Return whether they were last updated at another time of the stream: frames that come late are skipped."""
        return not self._places or self._places[-1][0] != seconds

    def update(self, seconds: float, place: Array, wish: tuple[float, float], plan: Array) -> None:
        """Show the character at a time of its stream, at a place (2,), with a target velocity, m/s, and the places
        (n, 2) that it plans."""
        self._places.append((seconds, np.array(place, dtype=np.float64)))
        while seconds - self._places[0][0] > _PAST_SECONDS or seconds < self._places[0][0]:
            self._places.popleft()
        self._present = place, wish, np.array([at for _, at in self._places]), plan
        self._set_bands(*self._present)

    def look_back(self, place: Array, wish: tuple[float, float], before: Array, after: Array) -> None:
        """Show a moment of the past instead: the character's place, its target velocity, and the places (n, 2) to
        which it went before and after."""
        self._set_bands(place, wish, before, after)

    def show_present(self) -> None:
        """Show what was shown last by `update`."""
        if self._present is not None:
            self._set_bands(*self._present)

    def _set_bands(self, place: Array, wish: tuple[float, float], past: Array, plan: Array) -> None:
        self._ahead.position = (float(place[0]), 0.0, float(place[1]))
        _set_band(self._wish, build_arrow(np.stack([np.zeros(2), np.array(wish)]), _WISH_WIDTH), _WISH_HEIGHT)
        _set_band(self._plan, build_arrow(plan - place, _PLAN_WIDTH), _PLAN_HEIGHT)
        _set_band(self._past, build_tail(past), _PAST_HEIGHT)


def build_arrow(points: Array, width: float) -> Array | None:
    """Build the edges (2 points, 2) of an arrow along points (n, 2), metres; None where it would be too short."""
    length = _measure_length(points)
    if length < _SLOWEST:
        return None
    head = min(_HEAD_METRES, 0.5 * length) / length
    shares = np.concatenate([np.linspace(0, 1 - head, _POINTS - 2), [1 - head, 1.0]])
    widths = np.concatenate([np.full(_POINTS - 2, width), [width * _HEAD_WIDTH, 0.0]])
    return _widen(_resample(points, shares), widths)


def build_tail(points: Array) -> Array | None:
    """Build the edges (2 points, 2) of a band along points (n, 2) that is narrow at its beginning; see build_arrow."""
    if _measure_length(points) < _SLOWEST:
        return None
    shares = np.linspace(0, 1, _POINTS)
    return _widen(_resample(points, shares), _PAST_WIDTH * shares)


def _set_band(band: viser.MeshHandle, edges: Array | None, height: float) -> None:
    if edges is not None:
        band.vertices = np.insert(edges, 1, height, axis=1).astype(np.float32)
    if band.visible != (edges is not None):
        band.visible = edges is not None


def _measure_length(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) if len(points) > 1 else 0.0


def _resample(points: Array, shares: Array) -> Array:
    """Return points at shares of the way's length."""
    arcs = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.stack([np.interp(shares * arcs[-1], arcs, points[:, k]) for k in range(2)], axis=-1)


def _widen(points: Array, widths: Array) -> Array:
    """Return the points of both edges, left and right in turn, of a band along points (n, 2)."""
    along = np.gradient(points, axis=0)
    along[-2:] = points[-1] - points[-3]  # the head's base has no length of its own
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    left = np.stack([along[:, 1], -along[:, 0]], axis=-1) * widths[:, None] / 2
    return np.stack([points + left, points - left], axis=1).reshape(-1, 2)


def _list_faces() -> Array:
    index = np.arange(2 * _POINTS).reshape(-1, 2)
    quads = np.concatenate([index[:-1], index[1:, ::-1]], axis=1)
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
