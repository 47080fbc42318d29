"""The panel's tabs. Whoever adds controls opens the tab that they belong to, so that their order is decided here."""

from enum import Enum

import viser


class Tab(Enum):
    """Tabs in the order in which they are shown, in one row."""

    STEER = "Steer"
    PATH = "Path"
    REACH = "Reach"
    PLAY = "Play"
    TERMS = "Terms"
    VIEW = "View"


_WIDTH = 340  # pixels of the panel, until a viewer drags its edge


class PanelLayout:
    """What is above the tabs, in the order in which it is added, and the tabs."""

    def __init__(self, gui: viser.GuiApi):
        """Dock the panel at the right edge, so that the picture lies beside it and not below."""
        self._gui = gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self._tabs: dict[Tab, viser.GuiTabHandle] = {}

    def add_tabs(self) -> None:
        """Add all tabs below what there is so far."""
        group = self._gui.add_tab_group()
        self._tabs = {tab: group.add_tab(tab.value) for tab in Tab}

    def open(self, tab: Tab) -> viser.GuiTabHandle:
        """Return a tab to be entered by `with`; what is added within goes below what it has."""
        return self._tabs[tab]
