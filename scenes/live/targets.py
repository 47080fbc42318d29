"""What users drag in the live viewer: the place that a hand reaches or the head looks at, and a disc to walk round."""

import math
from collections.abc import Callable

import numpy as np
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from scenes.live.ground import to_rgb_bytes
from scenes.live.inputs import Place, parse_place

_HANDLE_SIZE, _BALL_RADIUS = 0.25, 0.045  # metres
_DISC_HEIGHT, _DISC_COLOUR = 0.35, (185, 170, 156)
_TARGET_AHEAD, _TARGET_ASIDE, _TARGET_HEIGHT = 0.45, 0.3, 1.2  # metres from a character, where a target appears
_DISC_AHEAD = 2.5


class DraggableTarget:
    """A ball with a handle, to be dragged in all directions."""

    def __init__(self, scene: viser.SceneApi, name: str, moved: Callable[[Place], None]):
        """Add it, hidden; `moved` hears where it was dragged, on a browser's own time."""
        self._handle = scene.add_transform_controls(
            name, _HANDLE_SIZE, disable_rotations=True, depth_test=False, visible=False
        )
        scene.add_icosphere(f"{name}/ball", _BALL_RADIUS, color=to_rgb_bytes(colours.TARGET))
        _report_drags(self._handle, moved)

    def show(self, place: Place | None) -> None:
        """Show it at a place in the world, metres, or hide it."""
        self._handle.visible = place is not None
        if place is not None:
            self._handle.position = place


class DraggableDisc:
    """A disc on the ground with a handle, to be dragged over it."""

    def __init__(self, scene: viser.SceneApi, name: str, moved: Callable[[Place], None]):
        """Add it, hidden; see DraggableTarget."""
        self._scene, self._name = scene, name
        self._handle = scene.add_transform_controls(
            name,
            2 * _HANDLE_SIZE,
            disable_rotations=True,
            active_axes=(True, False, True),
            depth_test=False,
            visible=False,
        )
        self._radius = 0.0
        _report_drags(self._handle, moved)

    def show(self, obstacle: Obstacle | None) -> None:
        """Show it as it is, or hide it."""
        self._handle.visible = obstacle is not None
        if obstacle is None or obstacle.radius is None:
            return
        self._handle.position = (obstacle.place[0], _DISC_HEIGHT, obstacle.place[1])
        if self._radius != obstacle.radius:
            self._radius = obstacle.radius
            self._scene.add_cylinder(
                f"{self._name}/solid",
                self._radius,
                _DISC_HEIGHT,
                color=_DISC_COLOUR,
                opacity=0.8,
                wxyz=(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
                position=(0.0, -_DISC_HEIGHT / 2, 0.0),
            )


def place_before(place: np.ndarray, heading_deg: float, *, hand: str | None) -> Place:
    """Return where a target appears for a character at `place` (x and z, metres): before it, on the hand's side."""
    ahead = np.array([math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))])
    left = np.array([ahead[1], -ahead[0]])
    side = {"left": 1.0, "right": -1.0}.get(hand or "", 0.0)
    x, z = np.asarray(place, dtype=np.float64) + _TARGET_AHEAD * ahead + side * _TARGET_ASIDE * left
    return float(x), _TARGET_HEIGHT, float(z)


def disc_before(place: np.ndarray, heading_deg: float, radius: float) -> Obstacle:
    """Return the disc that appears in the way of a character at `place` (x and z, metres)."""
    x, z = np.asarray(place, dtype=np.float64)
    angle = math.radians(heading_deg)
    return Obstacle((float(x + _DISC_AHEAD * math.sin(angle)), float(z + _DISC_AHEAD * math.cos(angle))), radius)


def _report_drags(handle: viser.TransformControlsHandle, moved: Callable[[Place], None]) -> None:
    """Say where a user drags a handle; not where the show itself puts it. A coroutine, so that drags stay in order."""

    @handle.on_update
    async def _(event: viser.TransformControlsEvent) -> None:
        if event.client_id is not None and (place := parse_place(handle.position)) is not None:
            moved(place)
