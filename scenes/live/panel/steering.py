"""Controls of speed, directions, steps and labels."""

import viser

from mapctl.intent.steering import STEP_LENGTHS
from scenes.live.inputs import UNCONDITIONED, InputLimits, SteeringInputs
from scenes.live.panel.actions import ViewerActions
from scenes.live.panel.binding import bind_control

_DEFAULT_STEP_LENGTH = 0.65  # metres, where measured steps begin


class SteeringControls:
    """Sliders and lists of the chosen character's orders."""

    def __init__(self, gui: viser.GuiApi, deck: ViewerActions, bounds: InputLimits):
        self.speed = gui.add_slider("Speed, m/s", 0.0, bounds.fastest, 0.1, min(1.2, bounds.fastest))
        # Floats throughout: a browser's 1e300 as an int could not be sent on, and would end everybody's connection.
        self.heading = gui.add_slider("Heading, degrees", -180.0, 180.0, 1.0, 0.0, hint="0 is +Z, 90 is +X")
        self.strafe = gui.add_checkbox("Face a fixed way", False)
        self.facing = gui.add_slider("Facing, degrees", -180.0, 180.0, 1.0, 0.0, disabled=True)
        self.measured = gui.add_checkbox("Measured steps", False)
        self.step_length = gui.add_slider("Step length, m", *STEP_LENGTHS, 0.05, _DEFAULT_STEP_LENGTH, disabled=True)
        self.labels = {
            group: gui.add_dropdown(group.capitalize(), [UNCONDITIONED, *names])
            for group, names in bounds.labels.items()
        }
        typed = deck.typed
        bind_control(self.speed, lambda value: typed(speed=value))
        bind_control(self.heading, lambda value: typed(heading=value))
        bind_control(self.strafe, lambda value: typed(facing=self.facing.value if value else None))
        bind_control(self.facing, lambda value: typed(facing=value) if self.strafe.value else None)
        bind_control(self.measured, lambda value: typed(step_length=self.step_length.value if value else None))
        bind_control(self.step_length, lambda value: typed(step_length=value) if self.measured.value else None)
        for group, handle in self.labels.items():
            bind_control(handle, lambda value, of=group: typed(labels={of: value}))

    def show(self, orders: SteeringInputs) -> None:
        """Put the controls where the orders are, without giving them anew."""
        self.speed.value, self.heading.value = orders.speed, round(orders.heading)
        self.strafe.value, self.measured.value = orders.facing is not None, orders.step_length is not None
        if orders.facing is not None:
            self.facing.value = round(orders.facing)
        if orders.step_length is not None:
            self.step_length.value = orders.step_length
        for group, handle in self.labels.items():
            handle.value = orders.labels.get(group, UNCONDITIONED)
        self.enable(orders)

    def enable(self, orders: SteeringInputs) -> None:
        """Let the controls that mean something be used; their values stay."""
        for handle, disabled in ((self.facing, orders.facing is None), (self.step_length, orders.step_length is None)):
            if handle.disabled != disabled:
                handle.disabled = disabled
