"""Controls of what is reached for, looked at and walked round."""

import viser

from scenes.live.inputs import DISC_RADII, HANDS, SteeringInputs
from scenes.live.panel.actions import TargetActions
from scenes.live.panel.binding import bind_button, bind_control

_NO_HAND = "none"


class ReachingControls:
    """List, boxes and a slider."""

    def __init__(self, gui: viser.GuiApi, targets: TargetActions):
        self.hand = gui.add_dropdown("Hand", [_NO_HAND, *HANDS], hint="drag the ball that it reaches for")
        self.looks = gui.add_checkbox("Look at it", False)
        self.disc = gui.add_checkbox("Disc to walk round", False)
        self.radius = gui.add_slider("Radius, m", *DISC_RADII, 0.1, 0.5)
        bind_control(self.hand, lambda value: targets.aim(hand=None if value == _NO_HAND else value))
        bind_control(self.looks, lambda value: targets.aim(looks=value))
        bind_control(self.disc, lambda value: targets.put_disc(self.radius.value if value else None))
        bind_control(self.radius, lambda value: targets.put_disc(value) if self.disc.value else None)
        bind_button(gui.add_button("Bring them here", icon=viser.Icon.MAP_PIN), targets.bring)

    def show(self, orders: SteeringInputs) -> None:
        """Put the controls where the orders are, without giving them anew."""
        self.hand.value, self.looks.value = orders.hand or _NO_HAND, orders.looks
