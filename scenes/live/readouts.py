"""Numbers of the live viewer: target and actual speed, the ledger's terms as they change, and the cost of a frame."""

from collections import deque
from collections.abc import Sequence

import numpy as np
import viser
import viser.uplot as uplot

from mapctl.mesh import colours
from mapctl.runtime.live_protocol import FrameChunk

_PLOT_SECONDS = 10.0  # that the plots look back
_SPEED_FRAMES = 15  # frames over which the speed that is shown is taken
_PLOT_COLOURS = (colours.LEFT, colours.RIGHT, colours.TARGET, "#2f9e62", "#7d55c7", "#8d6346")


class Readouts:
    """Text and two plots, of one character at a time."""

    def __init__(self, gui: viser.GuiApi):
        """Add the text; `add_plots` adds the plots."""
        self._gui = gui
        self._text = gui.add_markdown("...")
        self._folder: viser.GuiFolderHandle | None = None
        self._plots: list[viser.GuiUplotHandle] = []
        self._rows: deque[tuple[float, ...]] = deque()
        self._names: tuple[str, ...] = ()
        self._places: deque[np.ndarray] = deque(maxlen=_SPEED_FRAMES + 1)
        self.forget()

    def add_plots(self) -> None:
        """Show the plots here, as soon as there is something to plot."""
        self._folder = self._gui.add_folder("Plots")

    def forget(self) -> None:
        """Restart: another character, or the same from its start."""
        self._rows.clear()
        self._places.clear()
        self._last: FrameChunk | None = None
        self.frames = self.late = 0
        self.speed = 0.0

    def add(self, delivered: FrameChunk, fps: float) -> None:
        """Add one more step."""
        count = len(delivered.root)
        self.frames += count
        self.late += delivered.late_frames
        self._places.extend(delivered.root[:, ::2])
        self._last = delivered
        way = self._places[-1] - self._places[0]
        self.speed = float(np.linalg.norm(way)) * fps / max(1, len(self._places) - 1)
        names = tuple(delivered.energies)
        if not names:
            return  # the first pose, which nobody solved
        if names != self._names:
            self._names = names
            self._rows.clear()
        wanted = float(np.hypot(*delivered.wish))
        self._rows.append((delivered.seconds, wanted, self.speed, *delivered.energies.values()))
        while self._rows[-1][0] - self._rows[0][0] > _PLOT_SECONDS:
            self._rows.popleft()

    def show(self) -> None:
        """Bring text and plots up to date; a few times a second is enough."""
        last = self._last
        if last is None or len(self._rows) < 2:
            return
        count = max(1, len(last.root))
        self._text.content = (
            f"**{self.speed:.2f} m/s**, wanted {self._rows[-1][1]:.2f}  \n"
            f"{1000 * last.compute_seconds / count:.1f} ms a frame · {self.late} of {self.frames} frames late"
        )
        if self._folder is not None:
            self._show_plots(self._folder)

    def _show_plots(self, folder: viser.GuiFolderHandle) -> None:
        table = np.array(self._rows)
        data = [(table[:, 0], table[:, 1], table[:, 2]), (table[:, 0], *table[:, 3:].T)]
        if len(self._plots) == 0:
            labels = [("wanted", "got"), self._names]
            titles = ("Speed, m/s", "Ledger, nats a frame")
            with folder:
                self._plots = [self._add_plot(*row) for row in zip(titles, data, labels, strict=True)]
        for plot, values in zip(self._plots, data, strict=True):
            plot.data = values

    def _add_plot(self, title: str, data: tuple[np.ndarray, ...], names: Sequence[str]) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="s")]
        series += [
            uplot.Series(label=name, stroke=ink, width=2) for name, ink in zip(names, _PLOT_COLOURS, strict=False)
        ]
        return self._gui.add_uplot(
            data,
            tuple(series),
            title=title,
            aspect=1.8,
            scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
            legend=uplot.Legend(show=True),
        )
