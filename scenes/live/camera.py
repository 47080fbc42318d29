"""The camera: it follows the chosen character by moving the world, so that each browser's camera stays the viewer's."""

import math
from enum import Enum

import numpy as np
import viser

from mapctl.mesh.primitives import Array
from scenes.cameras import fit_eye, look_at

_MOVE_RATE = 3.5  # 1/s: how soon the camera is where the character is; at an even pace it does not lag
_TURN_RATE = 2.6  # 1/s: how soon it is behind it; slow enough that hips which sway do not rock it
_JUMP_METRES = 2.0  # that no character goes in a frame: it was put elsewhere
_LONGEST_STEP = 0.1  # seconds; a page that slept does not leap
_STRIDE_SECONDS = 1.0  # over which facing is averaged, so that each stride's sway cancels
_FOV = math.radians(40.0)  # vertical
_MARGIN = 1.2  # of the picture's size to that of the characters in it
_NEAREST_METRES = 4.8  # from a single character
_AZIMUTH, _ELEVATION = math.radians(180 - 38), math.radians(15.0)  # behind the characters, from +Z toward +X
_BODY = np.array([0.45, 1.85, 0.55])  # half of the width, the height, half of the depth of a character's box, metres
_FIRST_ASPECT = 1.2  # of the picture beside the panel, until a browser connects


class CameraMode(Enum):
    """What the camera does as the chosen character moves."""

    CHASE = "chase: turns with the character"
    FOLLOW = "follow: does not turn"
    FREE = "stay"


class ChaseCamera:
    """Position and yaw of the world that follow a character smoothly: two critically damped springs.

    Points of the world are shown turned by `-yaw` about +Y after `position` was moved to the origin.
    """

    def __init__(self):
        self.mode = CameraMode.CHASE
        self.offset = 0.0
        """Angle by which viewers orbited the camera away from the character's back, radians."""
        self.position = np.zeros(2)
        self.yaw = 0.0
        self._speed, self._spin = np.zeros(2), 0.0
        self._last: Array | None = None
        self._facings: list[tuple[float, float]] = []

    def jump(self, position: Array, facing: float) -> None:
        """Be at a character at once, x and z in metres and radians from +Z toward +X."""
        self.position, self._last = np.array(position, dtype=np.float64), np.array(position, dtype=np.float64)
        self.yaw = facing + self.offset if self.mode is CameraMode.CHASE else self.yaw
        self._speed, self._spin = np.zeros(2), 0.0
        self._facings.clear()

    def switch(self, position: Array) -> None:
        """Follow another character from now on, at a position (2,), to which the camera glides."""
        self._last = np.array(position, dtype=np.float64)
        self._facings.clear()

    def orbit(self, angle: float) -> None:
        """Orbit the character to the left, radians."""
        self.offset += angle
        if self.mode is not CameraMode.CHASE:
            self.yaw += angle

    def step(self, seconds: float, position: Array, facing: float) -> None:
        """Go on for some seconds while a character is at a position, facing so; units as of `jump`."""
        if self.mode is CameraMode.FREE or seconds <= 0:
            self._last = np.array(position, dtype=np.float64)
            return
        if self._last is None or float(np.linalg.norm(position - self._last)) > _JUMP_METRES:
            self.jump(position, facing)
        seconds = min(seconds, _LONGEST_STEP)
        self._move(seconds, np.asarray(position, dtype=np.float64))
        if self.mode is CameraMode.CHASE:
            self._turn(seconds, facing)

    def to_view(self, points: Array) -> Array:
        """Return where points of the world (..., 3) are shown."""
        return turn_about_up(points - self._origin, -self.yaw)

    def to_world(self, points: Array) -> Array:
        """Return the points of the world (..., 3) that are shown there."""
        return turn_about_up(points, self.yaw) + self._origin

    def direction_to_world(self, directions: Array) -> Array:
        """Return the directions in the world (..., 3) that are shown so."""
        return turn_about_up(directions, self.yaw)

    @property
    def _origin(self) -> Array:
        return np.array([self.position[0], 0.0, self.position[1]])

    def _move(self, seconds: float, position: Array) -> None:
        assert self._last is not None
        steps, rate = max(1, math.ceil(seconds / 0.02)), _MOVE_RATE
        target = (position - self._last) / seconds
        for _ in range(steps):
            pull = rate * rate * (position - self.position) + 2 * rate * (target - self._speed)
            self._speed = self._speed + pull * seconds / steps
            self.position = self.position + self._speed * seconds / steps
        self._last = position.copy()

    def _turn(self, seconds: float, facing: float) -> None:
        now = self._facings[-1][0] + seconds if self._facings else 0.0
        self._facings.append((now, facing))
        self._facings = [one for one in self._facings if one[0] > now - _STRIDE_SECONDS]
        angles = np.array([angle for _, angle in self._facings])
        mean = math.atan2(np.sin(angles).mean(), np.cos(angles).mean())
        away = math.remainder(mean + self.offset - self.yaw, math.tau)
        steps, rate = max(1, math.ceil(seconds / 0.02)), _TURN_RATE
        for _ in range(steps):
            # A character that comes straight at the camera is not overtaken by it: it would swing round without end.
            pull = rate * rate * away * math.cos(away / 2) ** 2
            self._spin += (pull - 2 * rate * self._spin) * seconds / steps
            self.yaw += self._spin * seconds / steps
            away -= self._spin * seconds / steps


class WorldView:
    """The node of the world as the chase camera turns it, and the cameras of all browsers."""

    def __init__(self, server: viser.ViserServer, world: str, lamp: viser.FrameHandle, *, characters: int):
        """Move the node `world` and turn the node `lamp`; several characters are followed without turning."""
        self._server, self._lamp = server, lamp
        self._world = server.scene.add_frame(world, show_axes=False)
        self.chase = ChaseCamera()
        self.chase.mode = CameraMode.CHASE if characters == 1 else CameraMode.FOLLOW
        self._stepped: float | None = None
        self._shown = (np.inf, np.inf, np.inf)
        server.initial_camera.fov = _FOV

    def step(self, now: float, position: Array, facing: float) -> None:
        """Follow the chosen character until a value of time.perf_counter; units as of ChaseCamera."""
        seconds = 0.0 if self._stepped is None else now - self._stepped
        self._stepped = now
        self.chase.step(seconds, position, facing)
        yaw, origin = self.chase.yaw, self.chase.to_view(np.zeros(3))
        pose = (round(origin[0], 5), round(origin[2], 5), round(yaw, 6))
        if pose != self._shown:
            self._shown = pose
            self._world.position, self._world.wxyz = origin, (math.cos(yaw / 2), 0.0, -math.sin(yaw / 2), 0.0)
            self._lamp.wxyz = self._world.wxyz  # light comes from the same side of the world

    def next_mode(self) -> CameraMode:
        """Take the next mode, and return it."""
        modes = list(CameraMode)
        self.chase.mode = modes[(modes.index(self.chase.mode) + 1) % len(modes)]
        return self.chase.mode

    def show_all(self, positions: Array, clients: list[viser.ClientHandle] | None = None) -> None:
        """Bring characters at positions (n, 2) in the world into the view of these browsers, of all by default, and of
        those to come."""
        shown = self.chase.to_view(np.insert(positions, 1, 0.0, axis=1))[:, [0, 2]]
        first = self._server.initial_camera
        first.position, first.look_at = frame_characters(shown, _FIRST_ASPECT)
        for client in list(self._server.get_clients().values()) if clients is None else clients:
            if min(client.camera.image_width, client.camera.image_height) < 50:
                continue
            with client.atomic():
                client.camera.fov = _FOV
                client.camera.position, client.camera.look_at = frame_characters(shown, client.camera.aspect)

    def find_heading(self, direction: tuple[float, float], viewer: int | None) -> float:
        """Return the heading in the world, degrees, of a direction to the right and away as a browser's camera sees it;
        as the first browser's where that one is unknown."""
        clients = self._server.get_clients()
        client = clients.get(-1 if viewer is None else viewer, next(iter(clients.values()), None))
        camera = self._server.initial_camera if client is None else client.camera
        look = np.asarray(camera.look_at) - np.asarray(camera.position)
        right, away = direction
        shown = turn_about_up(np.array([-right, 0.0, away]), math.atan2(look[0], look[2]))
        x, _, z = self.chase.direction_to_world(shown)
        return math.degrees(math.atan2(x, z))

    def to_world_ray(self, ray: Array) -> Array:
        """Return a ray (2, 3), origin and direction as they are shown, in the world."""
        return np.stack([self.chase.to_world(ray[0]), self.chase.direction_to_world(ray[1])])


def frame_characters(positions: Array, aspect: float) -> tuple[Array, Array]:
    """Return the position of a camera, and the point that it looks at, with characters at positions (n, 2), x and z in
    metres, in view; `aspect` is width over height of the picture."""
    across = np.array([[x, z] for x in (-_BODY[0], _BODY[0]) for z in (-_BODY[2], _BODY[2])])
    flat = (positions[:, None] + across).reshape(-1, 2)
    corners = np.concatenate([np.insert(flat, 1, height, axis=1) for height in (0.0, _BODY[1])])
    level = np.array([math.sin(_AZIMUTH), 0.0, math.cos(_AZIMUTH)])
    back = math.cos(_ELEVATION) * level + math.sin(_ELEVATION) * np.array([0.0, 1.0, 0.0])
    framed = 2 * math.atan(math.tan(_FOV / 2) / _MARGIN)
    eye = fit_eye(corners, look_at(back, np.zeros(3))[:3, :3], fov=framed, aspect=aspect)
    x, z = positions.mean(axis=0)
    away = float((eye - np.array([x, _BODY[1] / 2, z])) @ back)
    eye, away = eye + max(0.0, _NEAREST_METRES - away) * back, max(away, _NEAREST_METRES)
    return eye, eye - away * back


def turn_about_up(points: Array, angle: float) -> Array:
    """Turn points (..., 3) about +Y; a quarter turn takes +Z to +X."""
    c, s = math.cos(angle), math.sin(angle)
    points = np.asarray(points, dtype=np.float64)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def facing_of(quat_xyzw: Array) -> float:
    """Return the facing of hips with a rotation (4,), radians from +Z toward +X."""
    x, y, z, w = quat_xyzw
    return math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))
