"""The controls of the live viewer. What a user does becomes a call on `ViewerActions`; the panel itself decides
nothing.

Callbacks are coroutines: those run in the order in which browsers did things, others on threads in any order.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import viser

from mapctl.intent.steering import STEP_LENGTHS
from scenes.live.inputs import DISC_RADII, HANDS, UNCONDITIONED, InputLimits, SteeringInputs
from scenes.live.recording import FORMATS

_SPEED_STEP, _HEADING_STEP = 0.2, 15.0  # m/s and degrees of one press of a key
_NO_HAND = "none"
_DEFAULT_STEP_LENGTH = 0.65  # metres, where measured steps begin


@runtime_checkable
class ViewerActions(Protocol):
    """Requests that the panel can make."""

    def order(self, **changes: Any) -> None:
        """Change the chosen character's orders, and show them; it leaves its path."""
        ...

    def typed(self, **changes: Any) -> None:
        """Change orders from a control, which already shows them and may still be typed into."""
        ...

    def nudge(self, **by: float) -> None:
        """Add to the chosen character's speed (m/s) or heading (degrees), as far as it goes."""
        ...

    def choose(self, character: int) -> None:
        """Choose the character whose orders are shown and changed from now on."""
        ...

    def toggle_pause(self) -> None:
        """Stop everybody, or go on."""
        ...

    def reset(self) -> None:
        """Restart all characters."""
        ...

    def walk_path(self) -> None:
        """Let the chosen character walk the drawn path."""
        ...

    def clear_path(self) -> None:
        """Forget the drawn points."""
        ...

    def toggle_recording(self, client: viser.ClientHandle | None) -> None:
        """Begin to record the chosen character, or end and give that browser the file."""
        ...


@runtime_checkable
class TargetActions(Protocol):
    """Requests about what is reached for, looked at and walked round."""

    def aim(self, **changes: Any) -> None:
        """Change what the chosen character reaches for and looks at: `hand`, `looks`, `target`; it keeps its path."""
        ...

    def put_disc(self, radius: float | None) -> None:
        """Put a disc to walk round, of a radius in metres; None takes it away."""
        ...

    def bring(self) -> None:
        """Put target and disc before the chosen character."""
        ...


class ControlPanel:
    """Sliders, lists, buttons and keys, shared by all browsers."""

    def __init__(
        self,
        gui: viser.GuiApi,
        deck: ViewerActions,
        targets: TargetActions,
        *,
        characters: int,
        bounds: InputLimits,
        below: Callable[[], None],
    ):
        """Build the controls; `below` adds what is shown below those that steer."""
        self._deck = deck
        self._who = None
        if characters > 1:
            self._who = gui.add_dropdown("Character", [str(k + 1) for k in range(characters)])
            self._bind_control(self._who, lambda value: deck.choose(int(value) - 1))
        with gui.add_folder("Steer"):
            self._add_steering(gui, bounds)
            below()
        with gui.add_folder("Path"):
            self.draw = gui.add_checkbox("Draw by clicking on the ground", False)
            _bind_button(gui.add_button("Walk it", icon=viser.Icon.ROUTE), deck.walk_path)
            _bind_button(gui.add_button("Clear", icon=viser.Icon.ERASER), deck.clear_path)
        with gui.add_folder("Reach and avoid"):
            self._add_targets(gui, targets)
        with gui.add_folder("Play"):
            self.follow = gui.add_checkbox("Follow the character", True)
            self.paused = gui.add_button("Pause")
            _bind_button(self.paused, deck.toggle_pause)
            _bind_button(gui.add_button("Reset"), deck.reset)
        with gui.add_folder("Record"):
            self.ending = gui.add_dropdown("File", list(FORMATS))
            self.record = gui.add_button("Record", color="red")
            _bind_client_button(self.record, deck.toggle_recording)
        self._add_hotkeys(gui)

    @property
    def character_list(self) -> Any:
        """The list of characters; there is one only for several."""
        return self._who

    def show(self, orders: SteeringInputs) -> None:
        """Put the controls where the orders are, without giving them anew."""
        self.speed.value, self.heading.value = orders.speed, round(orders.heading)
        self.strafe.value, self.measured.value = orders.facing is not None, orders.step_length is not None
        if orders.facing is not None:
            self.facing.value = round(orders.facing)
        if orders.step_length is not None:
            self.step_length.value = orders.step_length
        for group, handle in self.told.items():
            handle.value = orders.told.get(group, UNCONDITIONED)
        self.hand.value, self.looks.value = orders.hand or _NO_HAND, orders.looks
        self.enable(orders)

    def enable(self, orders: SteeringInputs) -> None:
        """Let the controls that mean something be used; their values stay."""
        for handle, disabled in ((self.facing, orders.facing is None), (self.step_length, orders.step_length is None)):
            if handle.disabled != disabled:
                handle.disabled = disabled

    def _add_steering(self, gui: viser.GuiApi, bounds: InputLimits) -> None:
        self.speed = gui.add_slider("Speed, m/s", 0.0, bounds.fastest, 0.1, min(1.2, bounds.fastest))
        # Floats throughout: a browser's 1e300 as an int could not be sent on, and would end everybody's connection.
        self.heading = gui.add_slider("Heading, degrees", -180.0, 180.0, 1.0, 0.0, hint="0 is +Z, 90 is +X")
        self.strafe = gui.add_checkbox("Face a fixed way", False)
        self.facing = gui.add_slider("Facing, degrees", -180.0, 180.0, 1.0, 0.0, disabled=True)
        self.measured = gui.add_checkbox("Measured steps", False)
        self.step_length = gui.add_slider("Step length, m", *STEP_LENGTHS, 0.05, _DEFAULT_STEP_LENGTH, disabled=True)
        self.told = {
            group: gui.add_dropdown(group.capitalize(), [UNCONDITIONED, *names])
            for group, names in bounds.labels.items()
        }
        typed = self._deck.typed
        self._bind_control(self.speed, lambda value: typed(speed=value))
        self._bind_control(self.heading, lambda value: typed(heading=value))
        self._bind_control(self.strafe, lambda value: typed(facing=self.facing.value if value else None))
        self._bind_control(self.facing, lambda value: typed(facing=value) if self.strafe.value else None)
        self._bind_control(self.measured, lambda value: typed(step_length=self.step_length.value if value else None))
        self._bind_control(self.step_length, lambda value: typed(step_length=value) if self.measured.value else None)
        for group, handle in self.told.items():
            self._bind_control(handle, lambda value, of=group: typed(told={of: value}))

    def _add_targets(self, gui: viser.GuiApi, targets: TargetActions) -> None:
        self.hand = gui.add_dropdown("Hand", [_NO_HAND, *HANDS], hint="drag the ball that it reaches for")
        self.looks = gui.add_checkbox("Look at it", False)
        self.disc = gui.add_checkbox("Disc to walk round", False)
        self.radius = gui.add_slider("Radius, m", *DISC_RADII, 0.1, 0.5)
        self._bind_control(self.hand, lambda value: targets.aim(hand=None if value == _NO_HAND else value))
        self._bind_control(self.looks, lambda value: targets.aim(looks=value))
        self._bind_control(self.disc, lambda value: targets.put_disc(self.radius.value if value else None))
        self._bind_control(self.radius, lambda value: targets.put_disc(value) if self.disc.value else None)
        _bind_button(gui.add_button("Bring them here", icon=viser.Icon.MAP_PIN), targets.bring)

    def _add_hotkeys(self, gui: viser.GuiApi) -> None:
        deck = self._deck
        keys: tuple[tuple[Any, str, Callable[[], None]], ...] = (
            ("W", "Faster", lambda: deck.nudge(speed=_SPEED_STEP)),
            ("S", "Slower", lambda: deck.nudge(speed=-_SPEED_STEP)),
            ("A", "Turn left", lambda: deck.nudge(heading=_HEADING_STEP)),
            ("D", "Turn right", lambda: deck.nudge(heading=-_HEADING_STEP)),
            ("X", "Stand", lambda: deck.order(speed=0.0)),
            ("B", "Turn round", lambda: deck.nudge(heading=180.0)),
            ("P", "Pause or go on", deck.toggle_pause),
            ("R", "Reset", deck.reset),
            ("G", "Walk the drawn path", deck.walk_path),
        )
        for key, label, action in keys:
            _bind_hotkey(gui.add_command(label, hotkey=key), action)

    def _bind_control(self, handle: Any, action: Callable[[Any], None]) -> None:
        """Act when a user moves a control, on what it shows then; not when the panel itself moves it."""

        @handle.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                action(handle.value)


def _bind_button(button: viser.GuiButtonHandle, action: Callable[[], None]) -> None:
    _bind_client_button(button, lambda client: action())


def _bind_client_button(button: viser.GuiButtonHandle, action: Callable[[viser.ClientHandle | None], None]) -> None:
    @button.on_click
    async def _(event: viser.GuiEvent) -> None:
        action(event.client)


def _bind_hotkey(command: viser.CommandHandle, action: Callable[[], None]) -> None:
    @command.on_trigger
    async def _(event: Any) -> None:
        action()
