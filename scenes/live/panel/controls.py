"""The controls of the live viewer. What a user does becomes a call on `ViewerActions`; the panel itself decides
nothing.
"""

from collections.abc import Callable
from typing import Any

import viser

from scenes.live.export.controls import RecordActions, RecordControls
from scenes.live.inputs import InputLimits, SteeringInputs
from scenes.live.page.keys import ACTIONS, KeyAction
from scenes.live.panel.actions import TargetActions, ViewActions, ViewerActions
from scenes.live.panel.binding import bind_control, bind_hotkey
from scenes.live.panel.layout import PanelLayout, Tab
from scenes.live.panel.playing import PlayControls
from scenes.live.panel.reaching import ReachingControls
from scenes.live.panel.steering import SteeringControls
from scenes.live.panel.viewing import ViewControls
from scenes.live.paths.controls import PathControls
from scenes.live.paths.editor import PathEditor
from scenes.live.view.chase import CameraMode


class ControlPanel:
    """Sliders, lists, buttons and keys, shared by all browsers."""

    def __init__(
        self,
        gui: viser.GuiApi,
        layout: PanelLayout,
        deck: ViewerActions,
        targets: TargetActions,
        views: ViewActions,
        path: PathEditor,
        records: RecordActions,
        *,
        characters: int,
        bounds: InputLimits,
        below: Callable[[], None],
        mode: CameraMode,
        theme: str,
    ):
        """Build the controls above the tabs and in them; `below` adds what is shown below those that steer."""
        self._who = None
        if characters > 1:
            self._who = gui.add_dropdown("Character", [str(k + 1) for k in range(characters)])
            bind_control(self._who, lambda value: deck.choose(int(value) - 1))
        self.play = PlayControls(gui, deck)
        layout.add_tabs()
        with layout.open(Tab.STEER):
            self.steering = SteeringControls(gui, deck, bounds)
            below()
        with layout.open(Tab.PATH):
            self.path = PathControls(gui, path, deck.walk_path)
        with layout.open(Tab.REACH):
            self.reaching = ReachingControls(gui, targets)
        with layout.open(Tab.PLAY):
            self.recording = RecordControls(gui, records)
        with layout.open(Tab.VIEW):
            self.viewing = ViewControls(gui, views, mode=mode, theme=theme)
        self._add_commands(gui, views)

    @property
    def character_list(self) -> Any:
        """The list of characters; there is one only for several."""
        return self._who

    def show(self, orders: SteeringInputs) -> None:
        """Put the controls where the orders are, without giving them anew."""
        self.steering.show(orders)
        self.reaching.show(orders)

    def enable(self, orders: SteeringInputs) -> None:
        """Let the controls that mean something be used; their values stay."""
        self.steering.enable(orders)

    @staticmethod
    def _add_commands(gui: viser.GuiApi, views: ViewActions) -> None:
        """List in viser's palette what keys do; the page's own script hears the keys."""
        for code, action in ACTIONS.items():
            if action is not KeyAction.HELP:
                command = gui.add_command(action.value.capitalize(), description=f"key {code.removeprefix('Key')}")
                bind_hotkey(command, lambda does=action: views.act(does))
