"""What is seen, decided on the show's own thread: camera, theme, and how the world is turned before the camera."""

from collections.abc import Callable

import numpy as np
import viser

from mapctl.mesh.primitives import Array
from scenes.live.actor import LiveActor
from scenes.live.cast import Cast
from scenes.live.page.messages import PageLayout
from scenes.live.view.chase import CameraMode, ChaseCamera
from scenes.live.view.scenery import Scenery
from scenes.live.view.themes import DARK, LIGHT, THEMES
from scenes.live.view.viewers import Viewers


class Director:
    """ViewActions without their queue."""

    def __init__(
        self, server: viser.ViserServer, world: str, cast: Cast, *, theme: str, themed: Callable[[bool], None]
    ):
        """Turn the node `world`; `themed` hears whether the theme is dark."""
        self._cast, self._themed = cast, themed
        self._world = server.scene.add_frame(world, show_axes=False)
        self.chase = ChaseCamera()
        if len(cast.members) > 1:
            self.chase.mode = CameraMode.FOLLOW
        self.chase.jump(cast.chosen.place, cast.chosen.facing)
        self._choice, self._prefers_dark = theme, False
        self._dark = theme == THEMES[1]
        self._scenery = Scenery(server, world, DARK if self._dark else LIGHT)
        self._viewers = Viewers(server, self._find_shown_places)
        self._stepped: float | None = None
        self._followed: LiveActor | None = None
        self._shown = (np.inf,) * 3

    @property
    def mode(self) -> CameraMode:
        """What the camera does."""
        return self.chase.mode

    def step(self, now: float) -> None:
        """Turn and move the world before the camera, at a value of time.perf_counter."""
        seconds = 0.0 if self._stepped is None else now - self._stepped
        self._stepped = now
        member = self._cast.chosen
        if member is not self._followed and member.is_shown:
            self._meet(member)
        self.chase.step(seconds, member.place, member.facing)
        x, _, z = self.chase.position
        pose = (round(x, 5), round(z, 5), round(self.chase.yaw, 6))
        if pose != self._shown:
            self._shown = pose
            self._world.position, self._world.wxyz = self.chase.position, self.chase.wxyz
            self._scenery.turn(-self.chase.yaw)

    def keep(self) -> None:
        """Frame the characters for browsers that came, once all have appeared."""
        if all(member.is_shown or member.gone for member in self._cast.members):
            self._viewers.keep()

    def cut(self) -> None:
        """Be at the chosen character at once."""
        self.chase.jump(self._cast.chosen.place, self._cast.chosen.facing)

    def set_mode(self, mode: CameraMode) -> None:
        """Have the camera turn with the character, follow it, or stay."""
        self.chase.mode = mode

    def next_mode(self) -> CameraMode:
        """Take the next of the cameras, and return it."""
        modes = list(CameraMode)
        self.chase.mode = modes[(modes.index(self.chase.mode) + 1) % len(modes)]
        return self.chase.mode

    def show_all(self) -> None:
        """Bring everybody into view."""
        self._viewers.frame_all()

    def turn(self, angle: float) -> None:
        """Turn the camera round the character to the left, radians."""
        self.chase.offset += angle
        if self.chase.mode is not CameraMode.CHASE:
            self.chase.turn_at_once(angle)

    def set_theme(self, name: str) -> None:
        """Change the colours, one of THEMES; another name changes nothing."""
        if name in THEMES:
            self._choice = name
            self._apply_theme()

    def lay_out(self, layout: PageLayout) -> None:
        """Heed where the panel of a page lies, and what colours it prefers."""
        if layout.viewer is not None:
            self._viewers.set_layout(layout.viewer, layout.size, layout.panel)
        self._prefers_dark = layout.prefers_dark
        self._apply_theme()

    def find_heading(self, direction: tuple[float, float], viewer: int | None) -> float:
        """Return the heading, degrees, of what is to the right and away as a browser's camera sees it."""
        x, _, z = self.chase.direct(self._viewers.find_direction(direction, viewer))
        return float(np.degrees(np.arctan2(x, z)))

    def locate_ray(self, ray: Array) -> Array:
        """Return a ray (2, 3), origin and direction as they are shown, in the world."""
        return np.stack([self.chase.locate(ray[0]), self.chase.direct(ray[1])])

    def _meet(self, member: LiveActor) -> None:
        """Go to another character smoothly; be at the first one at once."""
        if self._followed is None:
            self.cut()
        else:
            self.chase.go_over(member.place)
        self._followed = member

    def _apply_theme(self) -> None:
        dark = self._prefers_dark if self._choice == THEMES[2] else self._choice == THEMES[1]
        if dark != self._dark:
            self._dark = dark
            self._scenery.set_theme(DARK if dark else LIGHT)
            self._themed(dark)

    def _find_shown_places(self) -> Array:
        places = np.array([_ground(member) for member in self._cast.members])
        return self.chase.show(places)[:, [0, 2]]


def _ground(member: LiveActor) -> Array:
    return np.array([member.place[0], 0.0, member.place[1]])
