"""The panel: status, and controls in tabs. What a user does runs on the loop's thread; the panel decides nothing."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import viser

from mapctl.arguments import read_number
from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import REACHING_HANDS, Command
from scenes.live import paths
from scenes.live.camera import CameraMode
from scenes.live.character import KEPT_SECONDS, ShownCharacter
from scenes.live.inputs import DISC_RADII, UNCONDITIONED, WITHIN, read_degrees
from scenes.live.recording import FORMATS, Timeline

if TYPE_CHECKING:
    from scenes.live.app import LiveApp

_NO_HAND = "none"
_WALK_ON, _STAND = "walk on", "stand"
_LEGEND = "On the ground: **red** target velocity, **yellow** planned and past trajectory; discs are planted feet."


class Panel:
    """Sliders, lists and buttons, shared by all browsers."""

    def __init__(self, gui: viser.GuiApi, app: "LiveApp", *, characters: int):
        """Dock the panel at the right edge, and add all controls."""
        self._gui, self._app = gui, app
        gui.main_panel.dock_right()
        gui.main_panel.set_width(340)  # pixels
        self.status = gui.add_markdown("...")
        if characters > 1:
            names = [str(k + 1) for k in range(characters)]
            self._on_change(gui.add_dropdown("Character", names), lambda value: app.choose(names.index(value)))
        self.paused = self._add_button("Pause", lambda client: app.set_paused(not app.is_paused))
        self._add_button("Reset", lambda client: app.restart())
        tabs = gui.add_tab_group()
        for name, add in (
            ("Steer", self._add_steering),
            ("Path", self._add_path),
            ("Reach", self._add_targets),
            ("Play", self._add_playing),
            ("View", self._add_view),
        ):
            with tabs.add_tab(name):
                add()

    def _add_steering(self) -> None:
        gui, app, change = self._gui, self._app, self._app.change_from_panel
        self.speed = gui.add_slider("Speed, m/s", 0.0, app.fastest, 0.1, min(1.2, app.fastest))
        # Floats throughout: a browser's 1e300 as an int could not be sent on, and would end all connections.
        self.heading = gui.add_slider("Heading, degrees", -180.0, 180.0, 1.0, 0.0, hint="0 is +Z, 90 is +X")
        self.strafe = gui.add_checkbox("Face a fixed direction", False)
        self.facing = gui.add_slider("Facing, degrees", -180.0, 180.0, 1.0, 0.0)
        self.labels = {
            group: gui.add_dropdown(group.capitalize(), [UNCONDITIONED, *names]) for group, names in app.labels.items()
        }
        self._on_change(self.speed, lambda value: change(speed=read_number(value, "the speed")))
        self._on_change(self.heading, lambda value: change(heading=read_degrees(value)))
        self._on_change(self.strafe, lambda value: change(facing=read_degrees(self.facing.value) if value else None))
        self._on_change(
            self.facing, lambda value: change(facing=read_degrees(value)) if self.strafe.value is True else None
        )
        for group, handle in self.labels.items():
            self._on_change(handle, lambda value, of=group: app.label(app.chosen, of, value))

    def _add_path(self) -> None:
        gui, app, path = self._gui, self._app, self._app.path
        self.draw = gui.add_checkbox("Draw by clicking on the ground", False, hint=paths.HELP)
        self.closed = gui.add_checkbox("Closed to a loop", False, hint="a closed path is walked again and again")
        self.path = gui.add_markdown(paths.HELP)
        self._on_change(self.closed, lambda value: path.edit(path.points, closed=value is True))
        self._add_button("Walk it", lambda client: app.walk_path(), icon=viser.Icon.ROUTE)
        self._add_button("Clear", lambda client: path.edit([]), icon=viser.Icon.ERASER)
        hint = "x,z in metres, as mapctl follow reads it"
        self._add_button("Download CSV", app.download_path, icon=viser.Icon.DOWNLOAD, hint=hint)
        load = gui.add_upload_button("Load CSV or SVG", icon=viser.Icon.UPLOAD, mime_type=",".join(paths.ENDINGS))

        @load.on_upload
        async def _(event: viser.GuiEvent) -> None:
            app.enqueue(lambda: path.load(load.value.name, load.value.content))

        with gui.add_folder("Go there"):
            self.go = gui.add_checkbox("Go where I click on the ground", False)
            self.within = gui.add_slider("In, seconds", *WITHIN, 0.1, 2.0)
            self.turns = gui.add_checkbox("Face a fixed direction there", False)
            self.turn = gui.add_slider("Facing there, degrees", -180.0, 180.0, 1.0, 0.0, hint="0 is +Z, 90 is +X")
            self.then = gui.add_dropdown("Then", [_WALK_ON, _STAND])

    def _add_targets(self) -> None:
        gui, targets = self._gui, self._app.targets
        self.hand = gui.add_dropdown("Hand", [_NO_HAND, *REACHING_HANDS], hint="drag the ball that it reaches for")
        self.looks = gui.add_checkbox("Look at it", False)
        self.disc = gui.add_checkbox("Disc to walk round", False, hint="drag it to where it is to be")
        self.radius = gui.add_slider("Radius, m", *DISC_RADII, 0.1, 0.5)
        self._on_change(self.hand, lambda value: targets.reach(value if value in REACHING_HANDS else None))
        self._on_change(self.looks, lambda value: targets.look(value is True))
        self._on_change(self.disc, lambda value: targets.put_disc(self.radius.value if value else None))
        self._on_change(self.radius, lambda value: targets.put_disc(value) if self.disc.value else None)

    def _add_playing(self) -> None:
        gui, app = self._gui, self._app
        recorder, timeline = app.recorder, app.timeline
        self.ending = gui.add_dropdown("File", list(FORMATS), hint="mapctl render makes a film of it")
        self.record = self._add_button(
            "Record",
            lambda client: recorder.toggle(app.chosen, self.ending.value, client),
            color="red",
            icon=viser.Icon.PLAYER_RECORD,
        )
        self.recorded = gui.add_markdown("")
        hint = "the characters stop while you look at the past"
        self.back = gui.add_slider("Look back, s", -KEPT_SECONDS, 0.0, 0.1, 0.0, hint=hint)
        self.timeline = gui.add_markdown("")
        self._on_change(self.back, lambda value: timeline.look_back(-value))
        self._add_button("Replay", lambda client: timeline.replay(), icon=viser.Icon.PLAYER_PLAY)
        back = viser.Icon.PLAYER_TRACK_NEXT
        self._add_button("Back to live", lambda client: timeline.return_to_present(), icon=back)

    def _add_view(self) -> None:
        gui, app = self._gui, self._app
        modes = [mode.value for mode in CameraMode]
        camera = gui.add_dropdown("Camera", modes, initial_value=app.view.chase.mode.value)
        self._on_change(camera, lambda value: setattr(app.view.chase, "mode", CameraMode(value)))
        self._add_button("Show all", lambda client: app.show_all(), icon=viser.Icon.USERS)
        gui.add_markdown(_LEGEND)

    def read_journey(self) -> tuple[float, float | None, bool] | None:
        """Return seconds, facing (radians) and whether to stand there, if a click on the ground sends the character;
        None otherwise."""
        if self.go.value is not True:
            return None
        facing = read_degrees(self.turn.value) if self.turns.value is True else None
        return read_number(self.within.value, "the time"), facing, self.then.value == _STAND

    def show_command(self, command: Command) -> None:
        """Show a command in the controls, without sending it again."""
        self.speed.value, self.heading.value = command.speed, round(math.degrees(command.heading))
        self.strafe.value = command.facing is not None
        if command.facing is not None:
            self.facing.value = round(math.degrees(command.facing))
        chosen = dict(label.split("=", 1) for label in command.labels)
        for group, handle in self.labels.items():
            handle.value = chosen.get(group, UNCONDITIONED)
        self.hand.value = next(iter(command.reach), _NO_HAND)
        self.looks.value = command.look_at is not None

    def show_state(self, character: ShownCharacter, timeline: Timeline) -> None:
        """Bring all texts up to date; a few times a second is enough."""
        recorded, back = character.recorded, -round(timeline.seconds_back or 0.0, 1)
        self.status.content = character.describe_status()
        self.record.label = "Record" if recorded is None else "Stop and save"
        seconds = sum(len(chunk.root) for chunk in recorded or ()) / PRIOR_FPS
        self.recorded.content = "" if recorded is None else f"● **{seconds:.1f} s**"
        self.timeline.content = timeline.describe()
        if abs(self.back.value - back) > 0.05:
            self.back.value = back

    def _on_change(self, handle: Any, action: Callable[[Any], Any]) -> None:
        """Act when a user moves a control, on its value then; not when the server moves it."""

        # Coroutines run in the order in which browsers did things.
        @handle.on_update
        async def _(event: viser.GuiEvent) -> None:
            value = handle.value
            if event.client_id is not None:
                self._app.enqueue(lambda: action(value))

    def _add_button(self, label: str, action: Callable[[viser.ClientHandle | None], None], **look: Any) -> Any:
        """Add a button that acts for the browser in which it is pressed."""
        button = self._gui.add_button(label, **look)

        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._app.enqueue(lambda: action(event.client))

        return button
