"""Controls of the camera, of keys, and of the theme."""

import viser

from scenes.live.panel.actions import ViewActions
from scenes.live.panel.binding import bind_button, bind_control
from scenes.live.view.chase import CameraMode
from scenes.live.view.themes import THEMES

FROM_CAMERA, AS_IT_GOES = "as the camera sees it", "faster, slower, turn"
_LEGEND = (
    "On the ground **red** is what is wanted for the next second, **yellow** the way that it plans and where it "
    "came from; discs are planted feet."
)


class ViewControls:
    """Lists and a button."""

    def __init__(self, gui: viser.GuiApi, deck: ViewActions, *, mode: CameraMode, theme: str):
        self.camera = gui.add_dropdown("Camera", [mode.value for mode in CameraMode], initial_value=mode.value)
        bind_button(gui.add_button("Show all", icon=viser.Icon.USERS), deck.show_all)
        self.keys = gui.add_dropdown("Keys W A S D", [FROM_CAMERA, AS_IT_GOES], initial_value=FROM_CAMERA)
        self.marks = gui.add_checkbox("Arrows and trails", True)
        self.theme = gui.add_dropdown("Theme", list(THEMES), initial_value=theme)
        gui.add_markdown(_LEGEND)
        bind_control(self.camera, lambda value: deck.set_camera(CameraMode(value)))
        bind_control(self.keys, lambda value: deck.set_keys(from_camera=value != AS_IT_GOES))
        bind_control(self.marks, lambda value: deck.show_marks(value is True))
        bind_control(self.theme, deck.set_theme)

    def show_camera(self, mode: CameraMode) -> None:
        """Show which camera it is."""
        self.camera.value = mode.value
