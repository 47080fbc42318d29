"""Orders about what is seen, and orders by keys and gamepads: from the panel or a page, to the show's own thread."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import viser

from mapctl.mesh.primitives import Array
from scenes.live.cast import Cast
from scenes.live.notifications import Notifications
from scenes.live.page.channel import PageChannel
from scenes.live.page.driving import Driving
from scenes.live.page.keys import KeyAction, list_help
from scenes.live.page.messages import PageLayout
from scenes.live.panel.actions import ViewerActions
from scenes.live.view.chase import CameraMode
from scenes.live.view.director import Director


@runtime_checkable
class CameraList(Protocol):
    """The panel's list of cameras."""

    def show_camera(self, mode: CameraMode) -> None:
        """Show which camera it is."""
        ...


class Viewing:
    """ViewActions and DriverActions."""

    def __init__(
        self,
        server: viser.ViserServer,
        world: str,
        deck: ViewerActions,
        cast: Cast,
        channel: PageChannel,
        notices: Notifications,
        *,
        fastest: float,
        theme: str,
        enqueue: Callable[[Callable[[], None]], None],
    ):
        """Turn the node `world` before the camera; what keys ask for goes to `deck`. `enqueue` runs an action on the
        show's own thread."""
        self._deck, self._cast, self._channel, self._notices, self._enqueue = deck, cast, channel, notices, enqueue
        self._dark = theme == "dark"
        self.driving = Driving(self, fastest=fastest, tell=self._tell)
        """Keys and gamepads."""
        self._director = Director(server, world, cast, theme=theme, themed=self._heed_theme)
        self._list: CameraList | None = None
        self._greet()

    @property
    def mode(self) -> CameraMode:
        """What the camera does."""
        return self._director.mode

    def attach(self, cameras: CameraList) -> None:
        """Show in the panel's list which camera it is."""
        self._list = cameras

    def step(self, now: float) -> None:
        """Hear the pages, give the orders of what is held, and turn the world; `now` is of time.perf_counter."""
        for page, message in self._channel.poll():
            self.driving.hear(page, message)
            if isinstance(message, PageLayout):
                self._director.lay_out(message)
        self.driving.step(now)
        self._director.step(now)

    def keep(self, now: float) -> None:
        """Do what need not be done every time."""
        self._director.keep()
        self._channel.report(now, self._notices.console)

    def cut(self) -> None:
        """Be at the chosen character at once."""
        self._director.cut()

    def locate_ray(self, ray: Array) -> Array:
        """Return a ray (2, 3) of a click in the world."""
        return self._director.locate_ray(ray)

    def set_camera(self, mode: CameraMode) -> None:
        """See ViewActions."""
        self._enqueue(lambda: self._director.set_mode(mode))

    def show_all(self) -> None:
        """See ViewActions."""
        self._enqueue(self._director.show_all)

    def set_keys(self, *, from_camera: bool) -> None:
        """See ViewActions."""

        def chosen() -> None:
            self.driving.from_camera = from_camera
            self._greet()

        self._enqueue(chosen)

    def show_marks(self, shown: bool) -> None:
        """See ViewActions."""

        def done() -> None:
            for member in self._cast.members:
                member.tracks.show(shown)

        self._enqueue(done)

    def set_theme(self, name: str) -> None:
        """See ViewActions."""
        self._enqueue(lambda: self._director.set_theme(name))

    def order(self, **changes: Any) -> None:
        """See DriverActions."""
        self._deck.order(**changes)

    def nudge(self, **by: float) -> None:
        """See DriverActions."""
        self._deck.nudge(**by)

    def turn_camera(self, angle: float) -> None:
        """See DriverActions."""
        self._director.turn(angle)

    def find_heading(self, direction: tuple[float, float], viewer: int | None) -> float:
        """See DriverActions."""
        return self._director.find_heading(direction, viewer)

    def act(self, action: KeyAction) -> None:
        """See DriverActions."""
        deck = self._deck
        actions: dict[KeyAction, Callable[[], None]] = {
            KeyAction.STAND: lambda: deck.order(speed=0.0),
            KeyAction.TURN_ROUND: lambda: deck.nudge(heading=180.0),
            KeyAction.PAUSE: deck.toggle_pause,
            KeyAction.RESET: deck.reset,
            KeyAction.WALK_PATH: deck.walk_path,
            KeyAction.CAMERA: lambda: self._enqueue(self._take_next_camera),
            KeyAction.SHOW_ALL: self.show_all,
            KeyAction.NEXT: lambda: deck.choose((self._cast.number + 1) % len(self._cast.members)),
        }
        if action in actions:  # the list of keys is the page's own
            actions[action]()

    def _tell(self, title: str, text: str) -> None:
        self._notices.event(title, text, console=False)

    def _take_next_camera(self) -> None:
        mode = self._director.next_mode()
        if self._list is not None:
            self._list.show_camera(mode)
        self._tell("Camera", mode.value)

    def _heed_theme(self, dark: bool) -> None:
        self._dark = dark
        self._greet()

    def _greet(self) -> None:
        self._channel.greet(list_help(from_camera=self.driving.from_camera), dark=self._dark)
