"""The camera, floor and light: the camera follows the chosen character by moving the world, so that each browser's
camera stays the viewer's."""

import math
from enum import Enum
from typing import Any

import numpy as np
import viser

from mapctl.errors import RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from scenes.overlays import LIGHT

_MOVE_RATE = 3.5  # 1/s: how soon the camera is where the character is; at an even pace it does not lag
_TURN_RATE = 1.8  # 1/s: how soon it is behind it; slow enough that hips which sway do not rock it
_JUMP_METRES = 2.0  # that no character goes in a frame: it was put elsewhere
_LONGEST_STEP = 0.1  # seconds; a page that slept does not leap
WORLD = "/world"
"""Name of the node below which everything is that the camera turns."""
FOV = math.radians(40.0)
"""Vertical field of view, radians."""
_BODY_RADIUS, _BODY_MIDDLE = 1.1, 0.92  # metres around a character, and its height
_NEAREST_METRES = 4.8  # from a single character
_AZIMUTH, _ELEVATION = math.radians(180 - 38), math.radians(15.0)  # behind the characters, from +Z toward +X
_FIRST_ASPECT = 1.2  # of the picture beside the panel, until a browser connects
_MAX_COORDINATE, _MAX_RAY = 1e5, 100.0  # metres
_FLOOR, _LINE, _BRAND = "#dfe4eb", "#b9c2ce", (38, 98, 184)


class CameraMode(Enum):
    """Behaviour of the camera as the chosen character moves."""

    CHASE = "chase: turns with the character"
    FOLLOW = "follow: does not turn"
    FREE = "stay"


class ChaseCamera:
    """Position and yaw of the world that follow a character smoothly: two critically damped springs.

    Points of the world are shown turned by `-yaw` about +Y after `position` was moved to the origin.
    """

    def __init__(self, mode: CameraMode = CameraMode.CHASE):
        self.mode = mode
        self.position = np.zeros(2)
        self.yaw = 0.0
        self._speed, self._spin = np.zeros(2), 0.0
        self._last: Array | None = None

    def jump(self, position: Array, facing: float) -> None:
        """Be at a character at once, x and z in metres and radians from +Z toward +X."""
        self.position = self._last = np.array(position, dtype=np.float64)
        self.yaw = facing if self.mode is CameraMode.CHASE else self.yaw
        self._speed, self._spin = np.zeros(2), 0.0

    def switch(self, position: Array) -> None:
        """Follow another character from now on, at a position (2,), to which the camera glides."""
        self._last = np.array(position, dtype=np.float64)

    def step(self, seconds: float, position: Array, facing: float) -> None:
        """Go on for some seconds while a character is at a position, facing so; units as of `jump`."""
        position = np.array(position, dtype=np.float64)
        if self.mode is CameraMode.FREE or seconds <= 0:
            self._last = position
            return
        last = self._last
        if last is None or float(np.linalg.norm(position - last)) > _JUMP_METRES:
            self.jump(position, facing)
            last = position
        seconds = min(seconds, _LONGEST_STEP)
        pace = (position - last) / seconds
        off, speed = _relax(self.position - last, self._speed - pace, _MOVE_RATE, seconds)
        self.position, self._speed, self._last = position + off, speed + pace, position
        if self.mode is CameraMode.CHASE:
            off, self._spin = _relax(math.remainder(self.yaw - facing, math.tau), self._spin, _TURN_RATE, seconds)
            self.yaw = facing + off

    def to_view(self, points: Array) -> Array:
        """Return where points of the world (..., 3) are shown."""
        return turn_about_up(points - np.insert(self.position, 1, 0.0), -self.yaw)

    def to_world(self, points: Array) -> Array:
        """Return the points of the world (..., 3) that are shown there."""
        return turn_about_up(points, self.yaw) + np.insert(self.position, 1, 0.0)


def _relax(off: Any, speed: Any, rate: float, seconds: float) -> tuple[Any, Any]:
    """Return offset and speed of a critically damped spring after some time."""
    pull, decay = speed + rate * off, math.exp(-rate * seconds)
    return (off + pull * seconds) * decay, (speed - rate * pull * seconds) * decay


class WorldView:
    """Floor and light, the node of the world as the chase camera turns it, and the cameras of all browsers."""

    def __init__(self, server: viser.ViserServer, *, characters: int):
        """Add the node of the world, floor and light; several characters are followed without turning."""
        self._server, scene = server, server.scene
        scene.set_up_direction("+y")
        self._world = scene.add_frame(WORLD, show_axes=False)
        self._lamp = scene.add_frame("/lamp", show_axes=False)
        self.chase = ChaseCamera(CameraMode.CHASE if characters == 1 else CameraMode.FOLLOW)
        self._stepped: float | None = None
        server.initial_camera.fov = FOV
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_BRAND)
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map("studio", environment_intensity=0.42)
        scene.add_light_directional("/lamp/key", cast_shadow=True, intensity=1.7, position=tuple(-20.0 * LIGHT))
        scene.add_light_hemisphere("/sky", sky_color=(236, 242, 255), ground_color=(150, 146, 140), intensity=0.42)
        scene.set_background_image(np.full((2, 2, 3), to_rgb_bytes(colours.BACKGROUND), np.uint8), format="png")
        scene.add_grid(
            f"{WORLD}/floor",
            plane="xz",
            infinite_grid=True,
            cell_size=1.0,
            section_size=5.0,
            fade_distance=30.0,
            plane_opacity=1.0,
            plane_color=to_rgb_bytes(_FLOOR),
            cell_color=to_rgb_bytes(_LINE),
            section_color=to_rgb_bytes(colours.GRID),
            shadow_opacity=0.32,
        )

    def step(self, now: float, position: Array, facing: float) -> None:
        """Follow the chosen character until a value of time.perf_counter; units as of ChaseCamera."""
        self.chase.step(0.0 if self._stepped is None else now - self._stepped, position, facing)
        self._stepped, half = now, self.chase.yaw / 2
        self._world.position = self.chase.to_view(np.zeros(3)).round(5)
        self._world.wxyz = np.array([math.cos(half), 0.0, -math.sin(half), 0.0]).round(6)
        self._lamp.wxyz = self._world.wxyz  # light comes from the same side of the world

    def show_all(self, positions: Array, clients: list[viser.ClientHandle] | None = None) -> None:
        """Bring characters at positions (n, 2) in the world into the view of these browsers, of all by default, and of
        those to come."""
        shown = self.chase.to_view(np.insert(positions, 1, 0.0, axis=1))[:, [0, 2]]
        first = self._server.initial_camera
        first.position, first.look_at = frame_characters(shown, _FIRST_ASPECT)
        for client in list(self._server.get_clients().values()) if clients is None else clients:
            with client.atomic():
                client.camera.position, client.camera.look_at = frame_characters(shown, client.camera.aspect)

    def find_heading(self, direction: tuple[float, float], viewer: int | None) -> float:
        """Return the heading in the world, radians, of a direction to the right and away as a browser's camera sees it;
        as the first browser's where that one is unknown."""
        clients = self._server.get_clients()
        client = clients.get(-1 if viewer is None else viewer, next(iter(clients.values()), None))
        camera = self._server.initial_camera if client is None else client.camera
        look, (right, away) = np.asarray(camera.look_at) - np.asarray(camera.position), direction
        x, _, z = turn_about_up(np.array([-right, 0.0, away]), math.atan2(look[0], look[2]) + self.chase.yaw)
        return math.atan2(x, z)

    def find_ground(self, origin: Any, direction: Any) -> tuple[float, float] | None:
        """Return x and z in the world where a ray as a browser sent it meets the ground; None where it does not within
        100 m. RequestError where it is no ray."""
        try:
            ray = np.array([origin, direction], dtype=np.float64).reshape(2, 3)
        except (TypeError, ValueError):
            raise RequestError("a click without a position") from None
        if not (np.abs(ray) <= _MAX_COORDINATE).all():
            raise RequestError("a click without a position")
        far = -ray[0, 1] / min(ray[1, 1], -1e-9)
        if ray[1, 1] > -1e-3 or not 0 < far < _MAX_RAY:
            return None
        x, _, z = self.chase.to_world(ray[0] + far * ray[1]).tolist()
        return x, z


def frame_characters(positions: Array, aspect: float) -> tuple[Array, Array]:
    """Return the position of a camera, and the point that it looks at, with characters at positions (n, 2), x and z in
    metres, in view; `aspect` is width over height of the picture."""
    middle = positions.mean(axis=0)
    radius = _BODY_RADIUS + np.linalg.norm(positions - middle, axis=1).max()
    half = math.atan(math.tan(FOV / 2) * min(1.0, max(0.2, aspect)))
    level = np.array([math.sin(_AZIMUTH), 0.0, math.cos(_AZIMUTH)])
    back = math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * np.array([0.0, 1.0, 0.0])
    target = np.insert(middle, 1, _BODY_MIDDLE)
    return target + max(_NEAREST_METRES, radius / math.sin(half)) * back, target


def turn_about_up(points: Array, angle: float) -> Array:
    """Turn points (..., 3) about +Y; a quarter turn takes +Z to +X."""
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def to_rgb_bytes(colour: str) -> tuple[int, int, int]:
    """Return a colour as viser takes it, 0 to 255."""
    red, green, blue = (255 * colours.rgb(colour)).round().astype(int).tolist()
    return red, green, blue
