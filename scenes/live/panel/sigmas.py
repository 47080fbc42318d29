"""Sliders of the chosen character's sigmas, on a logarithmic scale."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import viser

from mapctl.errors import MapctlError
from mapctl.numerics.checks import is_number
from mapctl.runtime.live_protocol import SigmaRange
from scenes.live.actor import LiveActor
from scenes.live.panel.binding import bind_button, bind_control

_STEP = 0.1  # of a doubling
_TYPING_SECONDS = 1.0  # seconds after the last key in a field before it is put right
_HELP = "How exactly each term is to hold: **0** is the default, **+1** doubles the sigma, **-1** halves it."


class SigmaControls:
    """A slider for each sigma, which shows by how many doublings it differs from the default; its label has the value.

    Orders are carried out on the show's own thread, by `enqueue`.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        members: Sequence[LiveActor],
        chosen: Callable[[], LiveActor],
        enqueue: Callable[[Callable[[], None]], None],
    ):
        """Add the sliders of the sigmas that the first of the characters has."""
        self._chosen, self._enqueue = chosen, enqueue
        self._ranges = {one.name: one for one in members[0].character.sigmas}
        self._values: dict[int, dict[str, float]] = {id(member): {} for member in members}
        self._typed_at: float | None = None
        with gui.add_folder("Sigmas", expand_by_default=False):
            gui.add_markdown(_HELP)
            self.sliders = {name: self._add_slider(gui, one) for name, one in self._ranges.items()}
            self._text = gui.add_markdown("", visible=False)
            bind_button(gui.add_button("Reset the sigmas", icon=viser.Icon.REFRESH), self.reset)

    def change(self, name: str, doublings: Any) -> None:
        """Change a sigma of the chosen character; what cannot be is said, and the value before holds."""

        def changed() -> None:
            one, member = self._ranges[name], self._chosen()
            self._typed_at = time.perf_counter()
            if not is_number(doublings) or abs(float(doublings)) > 1000:
                return self._say(f"The sigma of {name} stays: what was typed is no number, or a very large one.")
            try:
                self._tune(member, {**self._values[id(member)], name: _to_value(one, float(doublings))})
            except MapctlError as error:
                return self._say(str(error))
            self._say("")
            self.sliders[name].label = _label(one, self._values[id(member)].get(name, one.default))
            return None

        self._enqueue(changed)

    def reset(self) -> None:
        """Give the chosen character its default sigmas."""

        def was_reset() -> None:
            self._tune(self._chosen(), {})
            self._say("")
            self.show()

        self._enqueue(was_reset)

    def show(self) -> None:
        """Show the sigmas of the chosen character."""
        values = self._values[id(self._chosen())]
        for name, slider in self.sliders.items():
            one = self._ranges[name]
            value = values.get(name, one.default)
            slider.label = _label(one, value)
            slider.value = round(math.log2(value / one.default), 2)

    def settle(self, now: float) -> None:
        """Put fields right into which nobody types any more, at a value of time.perf_counter."""
        if self._typed_at is not None and now - self._typed_at > _TYPING_SECONDS:
            self._typed_at = None
            self.show()

    def _tune(self, member: LiveActor, values: Mapping[str, float]) -> None:
        member.character.tune(values)
        self._values[id(member)] = dict(values)

    def _say(self, text: str) -> None:
        self._text.content, self._text.visible = f"⚠️ {text}", bool(text)

    def _add_slider(self, gui: viser.GuiApi, one: SigmaRange) -> viser.GuiSliderHandle[float]:
        low, high = (math.log2(end / one.default) for end in (one.low, one.high))
        slider = gui.add_slider(_label(one, one.default), round(low, 3), round(high, 3), _STEP, 0.0)
        bind_control(slider, lambda value: self.change(one.name, value))
        return slider


def _label(one: SigmaRange, value: float) -> str:
    return f"{one.label}, {value:.3g} {one.unit}".rstrip()


def _to_value(one: SigmaRange, doublings: float) -> float:
    """Return the sigma, at an end of its range where it differs from that by rounding alone."""
    value = one.default * 2.0**doublings
    return next((end for end in (one.low, one.high) if math.isclose(end, value, rel_tol=1e-6)), value)
