"""Where the world is before the camera: it goes past and turns, so that the camera stays the viewer's own to move."""

import math
from enum import Enum

import numpy as np

from mapctl.mesh.primitives import Array

_MOVE_RATE = 3.5  # 1/s: how soon the camera is where the character is; at an even pace it does not lag
_TURN_RATE = 2.6  # 1/s: how soon it is behind it; slow enough that hips which sway do not rock it
_JUMP_METRES = 2.0  # that nobody goes in a frame: the character was put elsewhere
_LONGEST_STEP = 0.1  # seconds; a page that slept does not leap
_STRIDE_SECONDS = 1.0  # over which facing is taken, so that each stride's sway cancels


class CameraMode(Enum):
    """What the camera does as the chosen character goes."""

    CHASE = "turns with the character"
    FOLLOW = "follows, does not turn"
    FREE = "stays"


class ChaseCamera:
    """A place and a direction of the world that follow a character smoothly.

    Both are springs that are damped as fast as they can be without overshooting. Points of the world are shown turned
    by `-yaw` about +Y after the place was taken to the origin.
    """

    def __init__(self):
        self.mode = CameraMode.CHASE
        self.offset = 0.0
        """Angle by which viewers turned the camera away from the character's back, radians."""
        self.place = np.zeros(2)
        self.yaw = 0.0
        self._speed, self._spin = np.zeros(2), 0.0
        self._last: Array | None = None
        self._facings: list[tuple[float, float]] = []

    def jump(self, place: Array, facing: float) -> None:
        """Be at a character at once, x and z in metres and radians from +Z toward +X."""
        self.place, self._last = np.array(place, dtype=np.float64), np.array(place, dtype=np.float64)
        self.yaw = facing + self.offset if self.mode is CameraMode.CHASE else self.yaw
        self._speed, self._spin = np.zeros(2), 0.0
        self._facings.clear()

    def go_over(self, place: Array) -> None:
        """Follow another character from now on, at a place (2,), to which the camera glides."""
        self._last = np.array(place, dtype=np.float64)
        self._facings.clear()

    def step(self, seconds: float, place: Array, facing: float) -> None:
        """Go on for some seconds while a character is at a place, facing so; units as of `jump`."""
        if self.mode is CameraMode.FREE or seconds <= 0:
            self._last = np.array(place, dtype=np.float64)
            return
        if self._last is None or float(np.linalg.norm(place - self._last)) > _JUMP_METRES:
            self.jump(place, facing)
        seconds = min(seconds, _LONGEST_STEP)
        self._move(seconds, np.asarray(place, dtype=np.float64))
        if self.mode is CameraMode.CHASE:
            self._turn(seconds, facing)

    def turn_at_once(self, angle: float) -> None:
        """Turn to the left, radians."""
        self.yaw += angle

    def show(self, points: Array) -> Array:
        """Return where points of the world (..., 3) are shown."""
        return turn_about_up(points - self._origin, -self.yaw)

    def locate(self, points: Array) -> Array:
        """Return the points of the world (..., 3) that are shown there."""
        return turn_about_up(points, self.yaw) + self._origin

    def direct(self, directions: Array) -> Array:
        """Return the directions in the world (..., 3) that are shown so."""
        return turn_about_up(directions, self.yaw)

    @property
    def position(self) -> tuple[float, float, float]:
        """Position of the world's node."""
        x, y, z = self.show(np.zeros(3)).tolist()
        return x, y, z

    @property
    def wxyz(self) -> tuple[float, float, float, float]:
        """Rotation of the world's node."""
        return math.cos(self.yaw / 2), 0.0, -math.sin(self.yaw / 2), 0.0

    @property
    def _origin(self) -> Array:
        return np.array([self.place[0], 0.0, self.place[1]])

    def _move(self, seconds: float, place: Array) -> None:
        assert self._last is not None
        steps, rate = max(1, math.ceil(seconds / 0.02)), _MOVE_RATE
        target = (place - self._last) / seconds
        for _ in range(steps):
            pull = rate * rate * (place - self.place) + 2 * rate * (target - self._speed)
            self._speed = self._speed + pull * seconds / steps
            self.place = self.place + self._speed * seconds / steps
        self._last = place.copy()

    def _turn(self, seconds: float, facing: float) -> None:
        now = self._facings[-1][0] + seconds if self._facings else 0.0
        self._facings.append((now, facing))
        self._facings = [one for one in self._facings if one[0] > now - _STRIDE_SECONDS]
        angles = np.array([angle for _, angle in self._facings])
        even = math.atan2(np.sin(angles).mean(), np.cos(angles).mean())
        away = math.remainder(even + self.offset - self.yaw, math.tau)
        steps, rate = max(1, math.ceil(seconds / 0.02)), _TURN_RATE
        for _ in range(steps):
            # Who comes straight at the camera is not overtaken by it, else it would swing round without end.
            pull = rate * rate * away * math.cos(away / 2) ** 2
            self._spin += (pull - 2 * rate * self._spin) * seconds / steps
            self.yaw += self._spin * seconds / steps
            away -= self._spin * seconds / steps


def turn_about_up(points: Array, angle: float) -> Array:
    """Turn points (..., 3) about +Y; a quarter turn takes +Z to +X."""
    c, s = math.cos(angle), math.sin(angle)
    points = np.asarray(points, dtype=np.float64)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def facing_of(quat_xyzw: Array) -> float:
    """Return the way that hips with a rotation (4,) face, radians from +Z toward +X."""
    x, y, z, w = quat_xyzw
    return math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))
