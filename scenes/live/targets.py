"""Handles that users drag: a target for hands and gaze, and a disc that all characters walk round."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import viser

from mapctl.curves.obstacles import Obstacle
from mapctl.mesh import colours
from scenes.live.camera import WORLD, to_rgb_bytes
from scenes.live.character import ShownCharacter
from scenes.live.inputs import WITHIN, Point, read_position

if TYPE_CHECKING:
    from scenes.live.app import LiveApp

_HANDLE_SIZE, _BALL_RADIUS, _GOAL_RADIUS = 0.25, 0.045, 0.08  # metres
_DISC_HEIGHT, _DISC_COLOUR, _DISC_AHEAD = 0.35, (185, 170, 156), 2.5
_TARGET_AHEAD, _TARGET_ASIDE, _TARGET_HEIGHT = 0.45, 0.3, 1.2  # metres from a character, where a target appears


class LiveTargets:
    """A target for each character, of which the chosen one's is shown, and a disc for all of them.

    Its methods are for the loop's thread.
    """

    def __init__(self, app: "LiveApp"):
        """Add the handles, hidden."""
        self._app, scene = app, app.server.scene
        look: dict[str, Any] = {"disable_rotations": True, "depth_test": False, "visible": False}
        red = to_rgb_bytes(colours.TARGET)
        self.target = scene.add_transform_controls(f"{WORLD}/target", _HANDLE_SIZE, **look)
        scene.add_icosphere(f"{WORLD}/target/ball", _BALL_RADIUS, color=red)
        ground = (True, False, True)
        self.disc = scene.add_transform_controls(f"{WORLD}/disc", 2 * _HANDLE_SIZE, active_axes=ground, **look)
        self._goal = scene.add_icosphere(f"{WORLD}/goal", _GOAL_RADIUS, color=red, visible=False)
        for handle, moved in ((self.target, self.move_target), (self.disc, self.move_disc)):

            @handle.on_update
            async def _(event: viser.TransformControlsEvent, handle: Any = handle, moved: Any = moved) -> None:
                position = handle.position
                if event.client_id is not None:  # not where the server moves it
                    app.enqueue(lambda: moved(read_position(position)))

    def reach(self, hand: str | None) -> None:
        """Have the chosen character reach for the target with a hand, one of REACHING_HANDS, or with none."""
        self._app.aim(self._app.chosen, reach={hand: self._find_target(hand)} if hand else {})

    def look(self, looks: bool) -> None:
        """Have the chosen character look at the target, or not."""
        self._app.aim(self._app.chosen, look_at=self._find_target(None) if looks else None)

    def move_target(self, point: Point) -> None:
        """Move the chosen character's target, metres."""
        now = self._app.chosen.wanted
        self._app.aim(self._app.chosen, reach=dict.fromkeys(now.reach, point), look_at=now.look_at and point)

    def show(self) -> None:
        """Show the chosen character's target where it has one."""
        point = self.point
        self.target.visible = point is not None
        if point is not None:
            self.target.position = point

    @property
    def point(self) -> Point | None:
        """Target of the chosen character, metres; None where it has none."""
        now = self._app.chosen.wanted
        return next(iter(now.reach.values()), now.look_at)

    def put_disc(self, radius: float | None) -> None:
        """Put a disc of a radius, metres, where there is one already or ahead of the chosen character; None removes
        it."""
        x, z = self._app.chosen.position + _DISC_AHEAD * self._axes()[0]
        position = next((disc.place for disc in self._app.chosen.wanted.obstacles), (float(x), float(z)))
        self._set_disc(None if radius is None else Obstacle(position, radius))

    def move_disc(self, point: Point) -> None:
        """Move the disc, metres."""
        for disc in self._app.chosen.wanted.obstacles:
            self._set_disc(replace(disc, place=(point[0], point[2])))

    def _set_disc(self, disc: Obstacle | None) -> None:
        """Have all characters walk round a disc, or round nothing."""
        self.disc.visible = disc is not None
        if disc is not None and disc.radius is not None:
            self.disc.position = (disc.place[0], _DISC_HEIGHT, disc.place[1])
            self._app.server.scene.add_cylinder(
                f"{WORLD}/disc/solid",
                disc.radius,
                _DISC_HEIGHT,
                color=_DISC_COLOUR,
                opacity=0.8,
                wxyz=(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
                position=(0.0, -_DISC_HEIGHT / 2, 0.0),
            )
        for character in self._app.characters:
            character.aim(replace(character.wanted, obstacles=() if disc is None else (disc,)))

    def go(self, character: ShownCharacter, position: tuple[float, float], within: float, facing: float | None) -> None:
        """Send a character to a position, x and z in metres, in so many seconds (WITHIN at least or at most), facing
        so, radians, and mark it; there it obeys its command."""
        within = min(WITHIN[1], max(WITHIN[0], within))
        character.character.go(character.wanted, position, within, facing)
        self._goal.position, self._goal.visible = (position[0], 0.0, position[1]), True

    def _find_target(self, hand: str | None) -> Point:
        """Return the chosen character's target; one before it, on the hand's side, where it has none."""
        ahead, left = self._axes()
        side = {"leftHand": 1.0, "rightHand": -1.0}.get(hand or "", 0.0)
        x, z = self._app.chosen.position + _TARGET_AHEAD * ahead + side * _TARGET_ASIDE * left
        return self.point or (float(x), _TARGET_HEIGHT, float(z))

    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        heading = self._app.chosen.wanted.heading
        ahead = np.array([math.sin(heading), math.cos(heading)])
        return ahead, np.array([ahead[1], -ahead[0]])
