"""Cameras: positions from which everything is in the picture. Pure functions, no graphics library."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, cast

import numpy as np
import scipy

from mapctl.errors import RequestError
from mapctl.mesh.primitives import Array, unit

_UP = np.array([0.0, 1.0, 0.0])
_FRAMING_MARGIN = 1.12
"""Ratio of the picture's size to that of what must be in it."""
_MAX_FRAMES = 400
"""Frames looked at to find the distance; more of a long motion would not change it."""


_AZIMUTH_DEG = 30.0
_SMOOTH_SECONDS = 0.6  # standard deviation of the Gaussian by which a following camera is smoothed
_BOUNDS = (("azimuth_deg", -360, 360), ("elevation_deg", 0, 89), ("fov_deg", 5, 120), ("zoom", 0.05, 20))


@dataclass(frozen=True)
class CameraSettings:
    """Settings of a film's camera. The distance is always found from the motion."""

    __pydantic_config__: ClassVar = {"extra": "forbid", "allow_inf_nan": False}

    kind: Literal["fixed", "follow", "top"] = "fixed"
    """Fixed: everything in view all the time. Follow: with the actors, smoothly. Top: fixed, from above."""
    azimuth_deg: float | None = None
    """Direction of the camera, degrees about +Y: 0 is +Z, 90 is +X. From the top it is what lies at the bottom. If not
    given, 30, and 0 from the top."""
    elevation_deg: float = 24.0
    """Elevation over the horizon, degrees, 0 to 89. Ignored from the top."""
    fov_deg: float = 32.0
    """Vertical field of view, degrees."""
    zoom: float = 1.0
    """Factor by which the camera is closer than needed (over 1) or further away; 2 halves the distance."""

    def __post_init__(self):
        if self.kind not in ("fixed", "follow", "top"):
            raise RequestError(f"the camera must be fixed, follow or top, got {self.kind!r}")
        for name, low, high in _BOUNDS:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise RequestError(f"the camera's {name} must be {low:g} to {high:g}, got {value:g}")


@dataclass(frozen=True, eq=False)
class View:
    """One camera at one time."""

    pose: Array
    """(4, 4) camera to world, looking along its -z, y up in the picture."""
    fov: float
    """Vertical field of view, radians."""
    width: int
    height: int

    def project(self, points: Array) -> Array:
        """Project world points (..., 3) to (..., 3): pixels right, pixels down, metres in front of the camera."""
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        depth = -local[..., 2]
        focal = self.height / 2 / np.tan(self.fov / 2)
        safe = np.where(np.abs(depth) < 1e-6, 1e-6, depth)
        right, down = (local[..., 0] / safe * focal + self.width / 2, -local[..., 1] / safe * focal + self.height / 2)
        return np.stack([right, down, depth], axis=-1)


def look_at(eye: Array, target: Array) -> Array:
    """Return the (4, 4) camera-to-world pose at `eye`, which is not right over or under the target."""
    back = unit(np.asarray(eye, float) - target)
    right = unit(np.cross(_UP, back))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = eye
    return pose


def camera_axes(settings: CameraSettings) -> Array:
    """Return (3, 3) columns right, up and back of the camera."""
    usual = 0.0 if settings.kind == "top" else _AZIMUTH_DEG
    azimuth = np.radians(usual if settings.azimuth_deg is None else settings.azimuth_deg)
    if settings.kind == "top":
        bottom = np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
        return np.stack([np.cross(-bottom, _UP), -bottom, _UP], axis=1)
    elevation = np.radians(settings.elevation_deg)
    level = np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
    back = np.cos(elevation) * level + np.sin(elevation) * _UP
    return look_at(back, np.zeros(3))[:3, :3]


def fit_eye(points: Array, axes: Array, *, fov: float, aspect: float) -> Array:
    """Find the nearest position (3,) from which a camera with the given axes sees all points (n, 3), in the middle.

    Each side of the picture bounds the eye by a plane. Left and right, and top and bottom, meet in two lines; the eye
    lies on the further one, and is centred in the direction that has room left.
    """
    right, up, back = (points @ axes).T
    wide, high = aspect * np.tan(fov / 2), np.tan(fov / 2)
    # How far back the tightest wedge starts that opens over all points, left and right, and up and down.
    wedges = ((right, wide), (up, high))
    away = max(((across / s + back).max() + (-across / s + back).max()) / 2 for across, s in wedges)
    depth = away - back
    return axes @ np.array([_find_centre(right, depth), _find_centre(up, depth), away])


def _find_centre(across: Array, depth: Array) -> float:
    """Find the sideways position that has the outermost points of both sides equally far from the middle."""
    depth = np.maximum(depth, 1e-6)

    def lopsided(position: float) -> float:
        seen = (across - position) / depth
        return float(seen.max() + seen.min())

    return cast(float, scipy.optimize.brentq(lopsided, across.min() - 1e-6, across.max() + 1e-6, xtol=1e-6))


def compute_views(
    settings: CameraSettings, points: Array, targets: Array, *, fps: float, size: tuple[int, int]
) -> list[View]:
    """Compute one view a frame.

    `points` (frames or 1, n, 3) must be seen; a following camera follows `targets` (frames, 3). `size` is the picture's
    width and height, pixels.
    """
    axes, fov = camera_axes(settings), np.radians(settings.fov_deg)
    centre = np.zeros_like(targets)
    if settings.kind == "follow":
        centre = _smooth(targets, _SMOOTH_SECONDS * fps)
        centre[:, 1] = np.median(targets[:, 1])
    seen = points - (centre[:, None] if len(points) == len(centre) else 0.0)
    seen = seen[:: max(1, len(seen) // _MAX_FRAMES)].reshape(-1, 3)
    framed = 2 * np.arctan(np.tan(fov / 2) * settings.zoom / _FRAMING_MARGIN)
    eye = fit_eye(seen, axes, fov=framed, aspect=size[0] / size[1])
    poses = np.tile(np.eye(4), (len(centre), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = axes, eye + centre
    return [View(pose, float(fov), *size) for pose in poses]


def _smooth(path: Array, sigma: float) -> Array:
    """Smooth a path (frames, 3); it is extended straight at both ends, so that it does not lag there."""
    margin = math.ceil(3 * sigma)
    longer = np.pad(path, ((margin, margin), (0, 0)), mode="reflect", reflect_type="odd")
    return scipy.ndimage.gaussian_filter1d(longer, sigma, axis=0, truncate=3.0)[margin : margin + len(path)]
