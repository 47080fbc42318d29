"""Notes of the live viewer: in the page, for as long as they hold or take to read, and on the console."""

import sys
import time
from collections.abc import Callable
from contextlib import suppress

import viser

from mapctl.errors import MapctlError
from scenes.live.access import format_error
from scenes.live.inputs import Refusal

_REFUSAL_SECONDS = 8.0  # seconds for which a refusal is shown
_REPEAT_SECONDS = 10.0  # seconds before the same message is shown again
_EVENT_SECONDS = 8.0
_MOST_STATES = 2  # that are shown at once, so that they do not push the controls away


class Notifications:
    """Lasting states on top of the panel, refusals below the controls, events as notes that pass."""

    def __init__(self, server: viser.ViserServer):
        """Put lasting states here; `below` puts the refusals."""
        self._server = server
        self._top = server.gui.add_markdown("", visible=False)
        self._refusals: viser.GuiMarkdownHandle | None = None
        self._states: dict[str, str] = {}
        self._shown: tuple[Refusal, float] | None = None
        self._said: dict[str, float] = {}

    def below(self) -> None:
        """Show refusals here."""
        self._refusals = self._server.gui.add_markdown("", visible=False)

    def state(self, key: str, text: str | None) -> None:
        """Set a state that holds until another text, or None, is given under its key."""
        if text is None:
            self._states.pop(key, None)
        else:
            self._states[key] = text
        shown = [f"⚠️ {text}" for text in list(self._states.values())[:_MOST_STATES]]
        if (more := len(self._states) - _MOST_STATES) > 0:
            shown.append(f"and {more} more like this")
        _set_text(self._top, "\n\n".join(shown))

    def show_refusals(self, refusals: list[Refusal]) -> None:
        """Show what was asked for and cannot be done."""
        if refusals:
            self._shown = refusals[-1], time.perf_counter()
            self._show_refusal("\n\n".join(refusal.text for refusal in refusals))

    def held(self, name: str, value: object) -> None:
        """Forget an order's refusal once it holds as asked, unless it is what came of the refusal (a field that is left
        puts itself right)."""
        if self._shown is not None and self._shown[0].name == name and self._shown[0].held != value:
            self._show_refusal("")

    def expire_refusal(self, now: float) -> None:
        """Take away what was shown long enough."""
        if self._shown is not None and now - self._shown[1] > _REFUSAL_SECONDS:
            self._show_refusal("")

    def event(self, title: str, body: str, *, console: bool = True) -> None:
        """Show an event in every browser; the same once in a while only."""
        if not self._is_new(f"{title} {body}"):
            return
        if console:
            self._print(f"{title}: {body}")
        for client in list(self._server.get_clients().values()):
            with suppress(Exception):  # it may have gone just now
                client.add_notification(title, body, auto_close_seconds=_EVENT_SECONDS)

    def fault(self, error: BaseException) -> None:
        """Report an error of the project's own, or of an unforeseen input; everything goes on."""
        if isinstance(error, MapctlError):
            self.event("Not done", str(error))  # what was asked cannot be
        else:
            self.event("Something went wrong", format_error(error))

    def run_safely(self, action: Callable[[], None]) -> None:
        """Run an action; report whatever goes wrong, and go on."""
        try:
            action()
        except Exception as error:
            self.fault(error)

    def console(self, text: str) -> None:
        """Print a line on standard error; the same once in a while only."""
        if self._is_new(text):
            self._print(text)

    def _show_refusal(self, text: str) -> None:
        if not text:
            self._shown = None
        if self._refusals is not None:
            _set_text(self._refusals, text)

    def _is_new(self, text: str) -> bool:
        now = time.perf_counter()
        self._said = {said: at for said, at in self._said.items() if now - at < _REPEAT_SECONDS}
        return self._said.setdefault(text, now) == now

    def _print(self, text: str) -> None:
        print(f"mapctl: {text}", file=sys.stderr, flush=True)


def _set_text(handle: viser.GuiMarkdownHandle, text: str) -> None:
    if handle.content != text:
        handle.content = text
    if handle.visible != bool(text):
        handle.visible = bool(text)
