"""Controls of recordings in the panel: what goes on, for how long, and how far its file is."""

from typing import Protocol, runtime_checkable

import viser

from scenes.live.export.recorder import Recorder
from scenes.live.panel.binding import bind_button, bind_client_button
from scenes.live.recording import FORMATS, Recording


@runtime_checkable
class RecordActions(Protocol):
    """Requests about recordings; they may come on any thread."""

    def toggle_recording(self, client: viser.ClientHandle | None) -> None:
        """Begin to record the chosen character, or end and give that browser the file."""
        ...

    def save_again(self, client: viser.ClientHandle | None) -> None:
        """Give a browser the last recording once more."""
        ...

    def cancel_export(self) -> None:
        """Break off the file that is being made."""
        ...


class RecordControls:
    """A list of files, buttons, a line of text, and a bar."""

    def __init__(self, gui: viser.GuiApi, actions: RecordActions):
        self.ending = gui.add_dropdown("File", list(FORMATS), hint="mp4 and gif are films, which take a while")
        self.record = gui.add_button("Record", color="red", icon=viser.Icon.PLAYER_RECORD)
        self._text = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._cancel = gui.add_button("Break off", icon=viser.Icon.X, visible=False, hint="the recording is kept")
        self._again = gui.add_button("Save again", icon=viser.Icon.DOWNLOAD, visible=False)
        bind_client_button(self.record, actions.toggle_recording)
        bind_client_button(self._again, actions.save_again)
        bind_button(self._cancel, actions.cancel_export)

    @property
    def chosen_ending(self) -> str:
        """Ending of the file that is asked for, one of FORMATS whatever a browser sent."""
        return self.ending.value if self.ending.value in FORMATS else FORMATS[0]

    def show(self, recorder: Recorder) -> None:
        """Bring everything up to date; a few times a second is enough."""
        recording, work = recorder.recording, recorder.work
        label = "Record" if recording is None else "Stop and save"
        if self.record.label != label:
            self.record.label = label
        lines = [] if recording is None else [f"● **{describe_length(recording)}**"]
        if work is not None:
            ending, state, waiting = work
            counted = f", {state.done} of {state.total} frames" if state.total else ""
            more = f"; {waiting} more to make" if waiting else ""
            lines.append(f"Making mapctl.{ending}{counted}{more} ...")
            self._show_bar(100 * state.done / state.total if state.total else None)
        elif recorder.last is not None and recording is None:
            lines.append(f"Last: {describe_length(recorder.last)}")
        text = "\n\n".join(lines)
        if self._text.content != text:
            self._text.content = text
        for handle, visible in (
            (self._text, bool(text)),
            (self._bar, work is not None),
            (self._cancel, work is not None),
            (self._again, recorder.last is not None and work is None),
        ):
            if handle.visible != visible:
                handle.visible = visible

    def _show_bar(self, percent: float | None) -> None:
        if self._bar.animated != (percent is None):
            self._bar.animated = percent is None
        value = 100.0 if percent is None else min(100.0, percent)
        if self._bar.value != value:
            self._bar.value = value


def describe_length(recording: Recording) -> str:
    """Describe how long a recording is: 1:02.3, 1869 frames."""
    minutes, seconds = divmod(recording.seconds, 60)
    return f"{int(minutes)}:{seconds:04.1f}, {recording.frames} frame{'s' * (recording.frames != 1)}"
