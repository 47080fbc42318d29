"""Controls of the path in the panel."""

from collections.abc import Callable

import viser

from scenes.live.panel.binding import bind_button, bind_client_button, bind_control
from scenes.live.paths import files
from scenes.live.paths.editor import PathEditor

_HELP = "Drag a ball to move it, a small one to insert a point there; Ctrl and a click removes one."


class PathControls:
    """What is done with points on the ground."""

    def __init__(self, gui: viser.GuiApi, editor: PathEditor, walk: Callable[[], None]):
        """Add the controls; `walk` lets the chosen character walk the path."""
        self._editor = editor
        self.draw = gui.add_checkbox("Draw by clicking on the ground", False, hint=_HELP)
        self.closed = gui.add_checkbox("Closed to a loop", False, hint="a closed path is walked on and on")
        self.text = gui.add_markdown(_HELP)
        bind_control(self.closed, lambda value: editor.close(bool(value)))
        bind_button(gui.add_button("Walk it", icon=viser.Icon.ROUTE), walk)
        bind_button(gui.add_button("Insert a point", icon=viser.Icon.PLUS), editor.insert)
        bind_button(gui.add_button("Remove the point", icon=viser.Icon.MINUS), editor.remove)
        bind_button(gui.add_button("Clear", icon=viser.Icon.ERASER), editor.clear)
        with gui.add_folder("Path file", expand_by_default=False):
            download = gui.add_button("Download CSV", icon=viser.Icon.DOWNLOAD, hint="mapctl follow reads it")
            keep = gui.add_button("Save here", icon=viser.Icon.DEVICE_FLOPPY, hint="in the folder of mapctl live")
            endings = ",".join(files.ENDINGS)
            load = gui.add_upload_button("Load CSV or SVG", icon=viser.Icon.UPLOAD, mime_type=endings)
        bind_client_button(download, editor.save)
        bind_button(keep, editor.keep)
        _bind_upload(load, editor)
        editor.changed = self.show

    def show(self, text: str) -> None:
        """Show what the path is, and what there is to say of it."""
        path = self._editor.path
        if self.closed.value != path.is_closed:
            self.closed.value = path.is_closed
        self.text.content = "\n\n".join(filter(None, (describe(self._editor), text)))


def describe(editor: PathEditor) -> str:
    """Describe the path in a line."""
    path = editor.path
    if not path.points:
        return _HELP
    curve = path.curve
    length = f", {curve.length:.1f} m" if curve is not None else ""
    chosen = f"; point {path.selected + 1} is selected" if path.selected is not None else ""
    return f"{len(path.points)} point{'s' * (len(path.points) != 1)}{length}{chosen}."


def _bind_upload(button: viser.GuiUploadButtonHandle, editor: PathEditor) -> None:
    @button.on_upload
    async def _(event: viser.GuiEvent) -> None:
        editor.load(button.value.name, button.value.content)
