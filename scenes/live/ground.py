"""Marks on the ground of the live viewer: planted feet; and where a click meets it."""

from contextlib import suppress
from typing import Any

import numpy as np
import viser

from mapctl.errors import RequestError
from mapctl.mesh import colours
from mapctl.mesh.primitives import Array
from mapctl.skeleton import TOES, Skeleton

_MARK_HEIGHT = 0.017  # metres over the ground, so that it does not flicker
_MAX_COORDINATE = 1e5  # metres from the origin beyond which nobody looks


class GroundMarks:
    """Planted feet and forecast of one character."""

    def __init__(self, scene: viser.SceneApi, name: str, skeleton: Skeleton):
        self._toes = skeleton.indices(TOES)
        vertices, faces = _build_disc()
        self._feet = [
            scene.add_mesh_simple(
                f"{name}/foot{k}",
                vertices,
                faces,
                color=to_rgb_bytes(colour),
                visible=False,
                side="double",
                cast_shadow=False,
            )
            for k, colour in enumerate((colours.LEFT, colours.RIGHT))
        ]

    def planted(self, joints: Array, contacts: Array) -> None:
        """Show a disc below each toe (of joints (joints, 3)) whose contact (2,) is 1."""
        for foot, toe, contact in zip(self._feet, self._toes, contacts, strict=True):
            foot.visible = bool(contact > 0.5)
            if foot.visible:
                foot.position = (joints[toe, 0], _MARK_HEIGHT, joints[toe, 2])


def parse_ray(origin: Any, direction: Any) -> Array:
    """Parse a ray (2, 3) from a browser; RequestError where it is none near the stage."""
    with suppress(TypeError, ValueError):
        ray = np.array([origin, direction], dtype=np.float64)
        if ray.shape == (2, 3) and np.isfinite(ray).all() and np.abs(ray).max() <= _MAX_COORDINATE:
            return ray
    raise RequestError("a click that is nowhere")


def intersect_ground(origin: Array, direction: Array) -> tuple[float, float] | None:
    """Return the x and z where a ray (two of (3,)) meets y = 0; None where it does not, or beyond 100 m."""
    if direction[1] > -1e-3:
        return None
    far = -origin[1] / direction[1]
    return (float(origin[0] + far * direction[0]), float(origin[2] + far * direction[2])) if 0 < far < 100 else None


def _build_disc(radius: float = 0.12, corners: int = 24) -> tuple[Array, Array]:
    turn = np.arange(corners) * 2 * np.pi / corners
    rim = np.stack([radius * np.sin(turn), np.zeros(corners), radius * np.cos(turn)], axis=-1)
    index = np.arange(1, corners + 1)
    return np.vstack([np.zeros(3), rim]), np.stack([np.zeros(corners, int), index, np.roll(index, -1)], axis=-1)


def to_rgb_bytes(colour: str) -> tuple[int, int, int]:
    """Return a colour as viser takes it, 0 to 255."""
    red, green, blue = (round(255 * float(share)) for share in colours.rgb(colour))
    return red, green, blue
