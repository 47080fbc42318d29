"""Controls of pause and restart."""

import viser

from scenes.live.panel.actions import ViewerActions
from scenes.live.panel.binding import bind_button


class PlayControls:
    """Pause and restart of everybody."""

    def __init__(self, gui: viser.GuiApi, deck: ViewerActions):
        self.paused = gui.add_button("Pause")
        bind_button(self.paused, deck.toggle_pause)
        bind_button(gui.add_button("Reset"), deck.reset)
