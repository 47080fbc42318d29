"""The controls of the live viewer. What somebody does becomes a call on `Deck`; the panel itself decides nothing."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import viser

from scenes.live.recording import FORMATS

AS_IT_LIKES = "any"
"""The choice that tells a prior nothing."""
_FASTER, _TURN = 0.2, 15.0  # m/s and degrees of one press of a key


@dataclass
class Orders:
    """What one character is to do, as the panel shows it."""

    speed: float = 1.2
    """m/s."""
    heading: float = 0.0
    """Degrees; 0 is +Z, 90 is +X."""
    facing: float | None = None
    """Degrees; None faces where it goes."""
    step_length: float | None = None
    """Metres; None steps as the prior does."""
    told: dict[str, str] = field(default_factory=dict)
    """By group of labels (gait, style) the one that is told."""


@runtime_checkable
class Deck(Protocol):
    """What the panel can ask for."""

    def order(self, **changes: Any) -> None:
        """Change the chosen character's orders; it leaves its path."""
        ...

    def choose(self, character: int) -> None:
        """Whose orders are shown and changed from now on."""
        ...

    def toggle_pause(self) -> None:
        """Stop everybody, or go on."""
        ...

    def reset(self) -> None:
        """Everybody begins anew."""
        ...

    def walk_path(self) -> None:
        """The chosen character walks the drawn path."""
        ...

    def clear_path(self) -> None:
        """Forget the drawn points."""
        ...

    def toggle_recording(self, client: viser.ClientHandle | None) -> None:
        """Begin to record the chosen character, or end and give that browser the file."""
        ...


class Panel:
    """Sliders, lists, buttons and keys, shared by all browsers."""

    def __init__(
        self, gui: viser.GuiApi, deck: Deck, *, characters: int, fastest: float, labels: Mapping[str, Sequence[str]]
    ):
        self._deck = deck
        self._who = None
        if characters > 1:
            self._who = gui.add_dropdown("Character", [str(k + 1) for k in range(characters)])
            self._on(self._who, lambda: deck.choose(int(self.who.value) - 1))
        with gui.add_folder("Steer"):
            self.speed = gui.add_slider("Speed, m/s", 0.0, round(fastest, 1), 0.1, 1.2)
            self.heading = gui.add_slider("Heading, degrees", -180, 180, 1, 0, hint="0 is +Z, 90 is +X")
            self.strafe = gui.add_checkbox("Face a fixed way", False)
            self.facing = gui.add_slider("Facing, degrees", -180, 180, 1, 0, disabled=True)
            self.measured = gui.add_checkbox("Measured steps", False)
            self.step_length = gui.add_slider("Step length, m", 0.3, 1.2, 0.05, 0.65, disabled=True)
            self.told = {group: gui.add_dropdown(group.capitalize(), [AS_IT_LIKES, *names])
                         for group, names in labels.items()}  # fmt: skip
        with gui.add_folder("Path"):
            self.draw = gui.add_checkbox("Draw by clicking on the ground", False)
            gui.add_button("Walk it", icon=viser.Icon.ROUTE).on_click(lambda _: deck.walk_path())
            gui.add_button("Clear", icon=viser.Icon.ERASER).on_click(lambda _: deck.clear_path())
        with gui.add_folder("Play"):
            self.follow = gui.add_checkbox("Follow the character", True)
            self.paused = gui.add_button("Pause")
            self.paused.on_click(lambda _: deck.toggle_pause())
            gui.add_button("Reset").on_click(lambda _: deck.reset())
        with gui.add_folder("Record"):
            self.ending = gui.add_dropdown("File", list(FORMATS))
            self.record = gui.add_button("Record", color="red")
            self.record.on_click(lambda event: deck.toggle_recording(event.client))
        for handle in (self.speed, self.heading, self.strafe, self.facing, self.measured, self.step_length,
                       *self.told.values()):  # fmt: skip
            self._on(handle, self._ordered)
        self._keys(gui)

    @property
    def who(self) -> Any:
        """The list of characters; there is one only for several."""
        return self._who

    def show(self, orders: Orders) -> None:
        """Put the controls where the orders are, without giving them anew."""
        self.speed.value, self.heading.value = orders.speed, round(orders.heading)
        self.strafe.value, self.facing.disabled = orders.facing is not None, orders.facing is None
        self.facing.value = round(orders.facing or 0.0)
        steps = orders.step_length
        self.measured.value, self.step_length.disabled = steps is not None, steps is None
        self.step_length.value = self.step_length.value if steps is None else steps
        for group, handle in self.told.items():
            handle.value = orders.told.get(group, AS_IT_LIKES)

    def _ordered(self) -> None:
        told = {group: handle.value for group, handle in self.told.items() if handle.value != AS_IT_LIKES}
        facing = float(self.facing.value) if self.strafe.value else None
        steps = float(self.step_length.value) if self.measured.value else None
        self._deck.order(speed=float(self.speed.value), heading=float(self.heading.value), facing=facing,
                         step_length=steps, told=told)  # fmt: skip

    def _keys(self, gui: viser.GuiApi) -> None:
        def speed(by: float) -> Callable[[], None]:
            return lambda: self._deck.order(speed=min(self.speed.max, max(0.0, self.speed.value + by)))

        def heading(by: float) -> Callable[[], None]:
            return lambda: self._deck.order(heading=math.remainder(self.heading.value + by, 360))

        deck = self._deck
        keys: tuple[tuple[Any, str, Callable[[], None]], ...] = (
            ("W", "Faster", speed(_FASTER)), ("S", "Slower", speed(-_FASTER)), ("A", "Turn left", heading(_TURN)),
            ("D", "Turn right", heading(-_TURN)), ("X", "Stand", lambda: deck.order(speed=0.0)),
            ("B", "Turn round", heading(180.0)), ("P", "Pause or go on", deck.toggle_pause),
            ("R", "Reset", deck.reset), ("G", "Walk the drawn path", deck.walk_path),
        )  # fmt: skip
        for key, label, action in keys:
            command = gui.add_command(label, hotkey=key)
            command.on_trigger(lambda _, act=action: act())

    def _on(self, handle: Any, action: Callable[[], None]) -> None:
        """Act when somebody moves a control; not when the panel itself does."""

        @handle.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                action()
