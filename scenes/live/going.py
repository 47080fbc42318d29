"""Clicks on the ground that send a character there: in so many seconds, facing so, to walk on or to stand."""

import math
from collections.abc import Sequence

import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from mapctl.numerics.checks import is_number
from scenes.live.actor import LiveActor
from scenes.live.ground import to_rgb_bytes
from scenes.live.inputs import WITHIN

_WALK_ON, _STAND = "walk on", "stand"
_MARK_RADIUS = 0.08  # metres


class GoThere:
    """The folder of the panel, and the mark on the ground."""

    def __init__(self, gui: viser.GuiApi, scene: viser.SceneApi, world: str):
        """Add both; the mark is hidden until somebody is sent there."""
        with gui.add_folder("Go there"):
            self.on = gui.add_checkbox("Go where I click on the ground", False)
            self.within = gui.add_slider("In, seconds", *WITHIN, 0.1, 2.0)
            self.faces = gui.add_checkbox("Face a fixed way there", False)
            self.facing = gui.add_slider("Facing there, degrees", -180.0, 180.0, 1.0, 0.0, hint="0 is +Z, 90 is +X")
            self.then = gui.add_dropdown("Then", [_WALK_ON, _STAND])
        self._mark = scene.add_icosphere(
            f"{world}/goal", _MARK_RADIUS, color=to_rgb_bytes(colours.TARGET), visible=False
        )

    def send(self, member: LiveActor, place: tuple[float, float], obstacles: Sequence[Obstacle]) -> bool:
        """Send a character to a place, x and z in metres, if clicks are for that; returns whether they are."""
        if self.on.value is not True:
            return False
        within, facing = self.within.value, self.facing.value if self.faces.value is True else None
        if not (is_number(within) and WITHIN[0] <= within <= WITHIN[1]) or not (facing is None or is_number(facing)):
            return True  # no browser of ours sends such
        member.go(place, within, None if facing is None else math.radians(facing), obstacles, stand=self._stands)
        self.mark(place)
        return True

    def mark(self, place: tuple[float, float]) -> None:
        """Show where somebody was sent, x and z in metres."""
        self._mark.position, self._mark.visible = (place[0], 0.0, place[1]), True

    @property
    def _stands(self) -> bool:
        return self.then.value == _STAND
