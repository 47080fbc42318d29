"""The ground of the live viewer: floor, sky and light, marks of planted feet, trajectories, and clicks on it."""

from contextlib import suppress
from typing import Any

import numpy as np
import viser

from mapctl.errors import RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from mapctl.skeleton import TOES, Skeleton
from scenes.overlays import LIGHT

_LAMP_METRES = 20.0  # from the origin; the direction alone matters
_SKY_ROWS, _SKY_END = 256, 0.55  # rows of the background; share of its height at which it has the horizon's colour
_ZENITH, _FLOOR, _LINE = "#b9c9de", "#dfe4eb", "#b9c2ce"
_KEY_LIGHT, _FILL_LIGHT, _SHADOW = 1.7, 0.42, 0.32
_BRAND = (38, 98, 184)  # of buttons
_MAX_COORDINATE, _MAX_RAY = 1e5, 100.0  # metres

# Heights over the ground, metres: marks that overlap must not flicker.
_PAST_HEIGHT, _PLAN_HEIGHT, _TARGET_HEIGHT, _FOOT_HEIGHT = 0.006, 0.010, 0.014, 0.017
_PAST_WIDTH, _PLAN_WIDTH, _TARGET_WIDTH, _FOOT_RADIUS = 0.035, 0.06, 0.075, 0.12
_POINTS = 24  # of every band
_HEAD_METRES, _HEAD_WIDTH = 0.20, 2.6  # length of an arrow's head, and its width over the shaft's
_FAR = 1e4  # metres of the vertices before anything is shown, so that a browser never culls a band
_SHORTEST = 0.12  # metres below which a band has no direction


def add_scenery(server: viser.ViserServer, world: str) -> viser.FrameHandle:
    """Add floor (below the node `world`), sky and light; return the node that turns the lamp."""
    scene = server.scene
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_BRAND)
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map("studio", environment_intensity=_FILL_LIGHT)
    lamp = scene.add_frame("/lamp", show_axes=False)
    scene.add_light_directional(
        "/lamp/key", cast_shadow=True, intensity=_KEY_LIGHT, position=tuple(-_LAMP_METRES * LIGHT)
    )
    scene.add_light_hemisphere("/sky", sky_color=(236, 242, 255), ground_color=(150, 146, 140), intensity=_FILL_LIGHT)
    share = np.clip(np.linspace(0, 1, _SKY_ROWS) / _SKY_END, 0, 1)
    share = (share * share * (3 - 2 * share))[:, None]
    rows = colours.blend_colours(colours.rgb(_ZENITH), colours.rgb(colours.BACKGROUND), share)
    scene.set_background_image(np.repeat((255 * rows).round().astype(np.uint8)[:, None], 2, axis=1), format="png")
    scene.add_grid(
        f"{world}/floor",
        plane="xz",
        infinite_grid=True,
        cell_size=1.0,
        section_size=5.0,
        cell_thickness=0.9,
        section_thickness=1.6,
        fade_distance=30.0,
        plane_opacity=1.0,
        plane_color=to_rgb_bytes(_FLOOR),
        cell_color=to_rgb_bytes(_LINE),
        section_color=to_rgb_bytes(colours.GRID),
        shadow_opacity=_SHADOW,
    )
    return lamp


class FootMarks:
    """A disc below each planted toe of one character."""

    def __init__(self, scene: viser.SceneApi, name: str, skeleton: Skeleton):
        """Add the discs, hidden."""
        self._toes = skeleton.indices(TOES)
        vertices, faces = _build_disc(_FOOT_RADIUS)
        self._feet = [
            _add_mark(scene, f"{name}/foot{k}", vertices, faces, colour)
            for k, colour in enumerate((colours.LEFT, colours.RIGHT))
        ]

    def show(self, joints: Array, contacts: Array) -> None:
        """Show a disc below each toe (of joints (joints, 3)) whose contact (2,) is 1."""
        for foot, toe, contact in zip(self._feet, self._toes, contacts, strict=True):
            foot.visible = bool(contact > 0.5)
            if foot.visible:
                foot.position = (joints[toe, 0], _FOOT_HEIGHT, joints[toe, 2])


class Trajectories:
    """Three flat bands of one character: target velocity (red), planned and past trajectory (yellow)."""

    def __init__(self, scene: viser.SceneApi, name: str):
        """Add the bands below a node, hidden until there is something to show."""
        self._node = scene.add_frame(name, show_axes=False)
        # A busy browser sets positions sooner than vertices, so what lies ahead moves with a node of its own.
        self._ahead = scene.add_frame(f"{name}/ahead", show_axes=False)
        vertices = np.linspace(-_FAR, _FAR, 2 * _POINTS)[:, None].repeat(3, axis=1)
        index = np.arange(2 * _POINTS).reshape(-1, 2)
        quads = np.concatenate([index[:-1], index[1:, ::-1]], axis=1)
        faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        self._target, self._plan, self._past = (
            _add_mark(scene, f"{name}/{what}", vertices, faces, colour)
            for what, colour in (
                ("ahead/target", colours.TARGET),
                ("ahead/plan", colours.TRAIL),
                ("past", colours.TRAIL),
            )
        )

    def show_all(self, visible: bool) -> None:
        """Show or hide all of it."""
        self._node.visible = visible

    def update(self, velocity: tuple[float, float], past: Array, plan: Array) -> None:
        """Show a target velocity, m/s, the past root trajectory (n, 2) up to now, and the planned one, metres."""
        here = past[-1]
        self._ahead.position = (float(here[0]), 0.0, float(here[1]))
        _set_band(self._target, build_arrow(np.array([[0.0, 0.0], velocity]), _TARGET_WIDTH), _TARGET_HEIGHT)
        _set_band(self._plan, build_arrow(plan - here, _PLAN_WIDTH), _PLAN_HEIGHT)
        _set_band(self._past, build_tail(past), _PAST_HEIGHT)


def build_arrow(points: Array, width: float) -> Array | None:
    """Build the edges (2 points, 2) of an arrow along points (n, 2), metres; None where it would be too short."""
    length = _measure_length(points)
    if length < _SHORTEST:
        return None
    head = min(_HEAD_METRES, 0.5 * length) / length
    shares = np.concatenate([np.linspace(0, 1 - head, _POINTS - 2), [1 - head, 1.0]])
    widths = np.concatenate([np.full(_POINTS - 2, width), [width * _HEAD_WIDTH, 0.0]])
    return _widen(_resample(points, shares), widths)


def build_tail(points: Array) -> Array | None:
    """Build the edges (2 points, 2) of a band along points (n, 2) that is narrow at its beginning; see build_arrow."""
    if _measure_length(points) < _SHORTEST:
        return None
    shares = np.linspace(0, 1, _POINTS)
    return _widen(_resample(points, shares), _PAST_WIDTH * shares)


def parse_ray(origin: Any, direction: Any) -> Array:
    """Parse a ray (2, 3) from a browser; RequestError where it is none."""
    with suppress(TypeError, ValueError):
        ray = np.array([origin, direction], dtype=np.float64)
        if ray.shape == (2, 3) and np.isfinite(ray).all() and np.abs(ray).max() <= _MAX_COORDINATE:
            return ray
    raise RequestError("a click without a position")


def intersect_ground(ray: Array) -> tuple[float, float] | None:
    """Return x and z where a ray (origin and direction, (2, 3)) meets y = 0; None where it does not within 100 m."""
    origin, direction = ray
    if direction[1] > -1e-3:
        return None
    far = -origin[1] / direction[1]
    x, _, z = (origin + far * direction).tolist()
    return (x, z) if 0 < far < _MAX_RAY else None


def to_rgb_bytes(colour: str) -> tuple[int, int, int]:
    """Return a colour as viser takes it, 0 to 255."""
    red, green, blue = (round(255 * float(share)) for share in colours.rgb(colour))
    return red, green, blue


def _add_mark(scene: viser.SceneApi, name: str, vertices: Array, faces: Array, colour: str) -> viser.MeshHandle:
    return scene.add_mesh_simple(
        name,
        vertices.astype(np.float32),
        faces,
        color=to_rgb_bytes(colour),
        side="double",
        cast_shadow=False,
        visible=False,
    )


def _build_disc(radius: float, corners: int = 24) -> tuple[Array, Array]:
    turn = np.arange(corners) * 2 * np.pi / corners
    rim = np.stack([radius * np.sin(turn), np.zeros(corners), radius * np.cos(turn)], axis=-1)
    index = np.arange(1, corners + 1)
    return np.vstack([np.zeros(3), rim]), np.stack([np.zeros(corners, int), index, np.roll(index, -1)], axis=-1)


def _set_band(band: viser.MeshHandle, edges: Array | None, height: float) -> None:
    if edges is not None:
        band.vertices = np.insert(edges, 1, height, axis=1).astype(np.float32)
    if band.visible != (edges is not None):
        band.visible = edges is not None


def _measure_length(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) if len(points) > 1 else 0.0


def _resample(points: Array, shares: Array) -> Array:
    """Return points at shares of the length along points (n, 2)."""
    arcs = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.stack([np.interp(shares * arcs[-1], arcs, points[:, k]) for k in range(2)], axis=-1)


def _widen(points: Array, widths: Array) -> Array:
    """Return the points of both edges, left and right in turn, of a band along points (n, 2)."""
    along = np.gradient(points, axis=0)
    along[-2:] = points[-1] - points[-3]  # the head's base has no length of its own
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    left = np.stack([along[:, 1], -along[:, 0]], axis=-1) * widths[:, None] / 2
    return np.stack([points + left, points - left], axis=1).reshape(-1, 2)
