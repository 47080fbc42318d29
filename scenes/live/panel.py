"""The panel: status, and controls in tabs. What a user does runs on the loop's thread; the panel decides nothing."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import viser

from mapctl.features import PRIOR_FPS
from mapctl.intent.steering import STEP_LENGTHS
from mapctl.streaming.messages import is_number
from scenes.live import paths
from scenes.live.camera import CameraMode
from scenes.live.character import KEPT_SECONDS, ShownCharacter
from scenes.live.inputs import DISC_RADII, HANDS, UNCONDITIONED, WITHIN, SteeringInputs
from scenes.live.recording import FORMATS, Recorder, Timeline

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
        gui, limits, change = self._gui, self._app.limits, self._app.change_from_panel
        self.speed = gui.add_slider("Speed, m/s", 0.0, limits.fastest, 0.1, min(1.2, limits.fastest))
        # Floats throughout: a browser's 1e300 as an int could not be sent on, and would end all connections.
        self.heading = gui.add_slider("Heading, degrees", -180.0, 180.0, 1.0, 0.0, hint="0 is +Z, 90 is +X")
        self.strafe = gui.add_checkbox("Face a fixed direction", False)
        self.facing = gui.add_slider("Facing, degrees", -180.0, 180.0, 1.0, 0.0, disabled=True)
        self.measured = gui.add_checkbox("Measured steps", False)
        self.step_length = gui.add_slider("Step length, m", *STEP_LENGTHS, 0.05, 0.65, disabled=True)
        self.labels = {
            group: gui.add_dropdown(group.capitalize(), [UNCONDITIONED, *names])
            for group, names in limits.labels.items()
        }
        self.refusal = gui.add_markdown("")
        self._on_change(self.speed, lambda value: change(speed=value))
        self._on_change(self.heading, lambda value: change(heading=value))
        self._on_change(self.strafe, lambda value: change(facing=self.facing.value if value else None))
        self._on_change(self.facing, lambda value: change(facing=value) if self.strafe.value else None)
        self._on_change(self.measured, lambda value: change(step_length=self.step_length.value if value else None))
        self._on_change(self.step_length, lambda value: change(step_length=value) if self.measured.value else None)
        for group, handle in self.labels.items():
            self._on_change(handle, lambda value, of=group: change(labels={of: value}))

    def _add_path(self) -> None:
        gui, app, path = self._gui, self._app, self._app.path
        self.draw = gui.add_checkbox("Draw by clicking on the ground", False, hint=paths.HELP)
        self.closed = gui.add_checkbox("Closed to a loop", False, hint="a closed path is walked again and again")
        self.path = gui.add_markdown(paths.HELP)
        self._on_change(self.closed, lambda value: path.edit(path.points, closed=value is True))
        walk = self._add_button("Walk it", lambda client: app.walk(app.chosen, path.points, closed=path.is_closed))
        walk.icon = viser.Icon.ROUTE
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
        self.hand = gui.add_dropdown("Hand", [_NO_HAND, *HANDS], hint="drag the ball that it reaches for")
        self.looks = gui.add_checkbox("Look at it", False)
        self.disc = gui.add_checkbox("Disc to walk round", False, hint="drag it to where it is to be")
        self.radius = gui.add_slider("Radius, m", *DISC_RADII, 0.1, 0.5)
        self._on_change(self.hand, lambda value: targets.reach(value if value in HANDS else None))
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
        again = self._add_button("Save again", lambda client: recorder.save_last(self.ending.value, client))
        again.icon = viser.Icon.DOWNLOAD
        hint = "the characters stop while you look at the past"
        self.back = gui.add_slider("Look back, s", -KEPT_SECONDS, 0.0, 0.1, 0.0, hint=hint)
        self.timeline = gui.add_markdown("")
        self._on_change(self.back, lambda value: timeline.look_back(-value))
        self._add_button("Replay", lambda client: timeline.replay(), icon=viser.Icon.PLAYER_PLAY)
        live = self._add_button("Back to live", lambda client: timeline.return_to_present())
        live.icon = viser.Icon.PLAYER_TRACK_NEXT

    def _add_view(self) -> None:
        gui, app = self._gui, self._app
        modes = [mode.value for mode in CameraMode]
        camera = gui.add_dropdown("Camera", modes, initial_value=app.view.chase.mode.value)
        self._on_change(camera, lambda value: setattr(app.view.chase, "mode", CameraMode(value)))
        self._add_button("Show all", lambda client: app.show_all(), icon=viser.Icon.USERS)
        gui.add_markdown(_LEGEND)

    def read_journey(self) -> tuple[float, float | None, bool] | None:
        """Return seconds, facing (degrees) and whether to stand there, if a click on the ground sends the character;
        None otherwise."""
        within, facing = self.within.value, self.turn.value if self.turns.value is True else None
        if self.go.value is not True or not is_number(within) or not (facing is None or is_number(facing)):
            return None
        return min(WITHIN[1], max(WITHIN[0], within)), facing, self.then.value == _STAND

    def show_inputs(self, inputs: SteeringInputs) -> None:
        """Show inputs in the controls, without sending them again."""
        self.speed.value, self.heading.value = inputs.speed, round(inputs.heading)
        self.strafe.value, self.measured.value = inputs.facing is not None, inputs.step_length is not None
        if inputs.facing is not None:
            self.facing.value = round(inputs.facing)
        if inputs.step_length is not None:
            self.step_length.value = inputs.step_length
        for group, handle in self.labels.items():
            handle.value = inputs.labels.get(group, UNCONDITIONED)
        self.hand.value = next(iter(inputs.reach), _NO_HAND)
        self.looks.value = inputs.look_at is not None
        self.enable(inputs)

    def enable(self, inputs: SteeringInputs) -> None:
        """Enable the controls that have an effect."""
        self.facing.disabled, self.step_length.disabled = inputs.facing is None, inputs.step_length is None

    def show_state(self, character: ShownCharacter, recorder: Recorder, timeline: Timeline) -> None:
        """Bring all texts up to date; a few times a second is enough."""
        recorded, back = character.recorded, -round(timeline.seconds_back or 0.0, 1)
        self.status.content = character.describe_status()
        self.record.label = "Record" if recorded is None else "Stop and save"
        if recorded is not None:
            self.recorded.content = f"● **{sum(len(chunk.root) for chunk in recorded) / PRIOR_FPS:.1f} s**"
        else:
            self.recorded.content = "" if recorder.last is None else f"Last: {recorder.last.seconds:.1f} s"
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
