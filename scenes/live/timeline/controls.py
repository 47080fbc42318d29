"""Controls of slow motion and of the past, in the panel."""

from typing import Protocol, runtime_checkable

import viser

from mapctl.numerics.checks import is_number
from scenes.live.panel.binding import bind_button, bind_control
from scenes.live.timeline.ring import KEPT_SECONDS
from scenes.live.timeline.timeline import RATES, Timeline

_SHOWN_DIFFERENCE = 0.05  # seconds by which the slider may be off before it is put right


@runtime_checkable
class TimelineActions(Protocol):
    """Requests about time; they may come on any thread."""

    def set_rate(self, rate: float) -> None:
        """Let time pass at a rate, 1 or less."""
        ...

    def look_back(self, seconds: float) -> None:
        """Show what was so many seconds ago."""
        ...

    def replay(self) -> None:
        """Play from there to the present."""
        ...

    def return_to_present(self) -> None:
        """Show the present again."""
        ...


class TimelineControls:
    """A list of rates, a slider over the last two minutes, and buttons."""

    def __init__(self, gui: viser.GuiApi, actions: TimelineActions):
        self._rate = gui.add_dropdown(
            "Speed of time", list(RATES), hint="slow motion of the characters, and of replays"
        )
        self._slider = gui.add_slider(
            "Look back, s", -KEPT_SECONDS, 0.0, 0.1, 0.0, hint="the characters stop while you look at the past"
        )
        self._text = gui.add_markdown("")
        replay = gui.add_button("Replay", icon=viser.Icon.PLAYER_PLAY, hint="from there, or all that is kept")
        self._present = gui.add_button("Back to live", icon=viser.Icon.PLAYER_TRACK_NEXT, disabled=True)
        bind_control(self._rate, lambda value: actions.set_rate(RATES[value]) if value in RATES else None)
        bind_control(self._slider, lambda value: actions.look_back(-value) if is_number(value) else None)
        bind_button(replay, actions.replay)
        bind_button(self._present, actions.return_to_present)

    def show(self, timeline: Timeline) -> None:
        """Bring the controls up to date; a few times a second is enough."""
        back, is_past = timeline.seconds_back, timeline.cursor is not None
        if abs(self._slider.value + back) > _SHOWN_DIFFERENCE:
            self._slider.value = -round(back, 1)
        if self._present.disabled == is_past:
            self._present.disabled = not is_past
        text = _describe(timeline)
        if self._text.content != text:
            self._text.content = text


def _describe(timeline: Timeline) -> str:
    slow = "" if timeline.clock.rate == 1 else f" at {_name_rate(timeline.clock.rate)} of real time"
    if timeline.cursor is None:
        kept = timeline.kept_seconds
        whole = "2 minutes" if kept >= KEPT_SECONDS - 1 else f"{kept:.0f} s"
        return f"Live{slow}. The last {whole} can be looked at."
    doing = f"Replay{slow}" if timeline.is_replaying else "The past"
    return f"**{doing}, {timeline.seconds_back:.1f} s ago.** The characters wait."


def _name_rate(rate: float) -> str:
    return next((name for name, value in RATES.items() if value == rate), f"{rate:g}")
