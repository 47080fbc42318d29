"""Pictures of transitions: errors over the frames of a gap (Ren et al. 2024, figure 6)."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

from scenes.plots import open_plots

_COLOURS = ("#4c78a8", "#e45756", "#54a24b", "#b279a2", "#f58518", "#72b7b2")


def plot_errors(rows: Sequence[Mapping[str, Any]], path: str | PathLike[str]) -> None:
    """Write a PNG of rows as `controllers.benchmarks.transitions.over_time` measures them: a line is the mean error,
    and the shade about it goes from the nearest answer to the farthest. RequestError without matplotlib."""
    with open_plots(path, 1, inches=(8, 4.5), dpi=110) as plot:
        for number, name in enumerate(dict.fromkeys(row["by"] for row in rows)):
            own, colour = [row for row in rows if row["by"] == name], _COLOURS[number % len(_COLOURS)]
            frames = [row["frame"] for row in own]
            plot.plot(frames, [row["error_cm"] for row in own], color=colour, label=name)
            nearest, farthest = ([row[key] for row in own] for key in ("nearest_cm", "farthest_cm"))
            plot.fill_between(frames, nearest, farthest, color=colour, alpha=0.2, linewidth=0)
        plot.set(xlabel="frame of the gap", ylabel="error of joints, cm", ylim=(0, None))
        plot.legend(frameon=False)
