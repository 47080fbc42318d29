"""Plots of how good models are by how much motion they were trained on."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np

from scenes.plots import open_plots

_INCHES, _DPI = (3.6, 2.9), 100


@dataclass(frozen=True)
class Scaling:
    """One model, trained on several amounts of motion."""

    name: str
    """Of the model."""
    measure: str
    """What is measured on unseen clips, smaller where it is better."""
    minutes: tuple[float, ...]
    """Of motion that was trained on, the least first."""
    values: tuple[float, ...]
    """Of the measure."""
    change: float
    """Percent by which the error changes with twice the motion, between the two largest amounts."""


def plot_scaling(models: Sequence[Scaling], path: str | PathLike[str]) -> None:
    """Write a PNG with a plot for each model: the measure over minutes of motion, each doubling as wide as another.

    RequestError without matplotlib.
    """
    inches = (_INCHES[0] * len(models), _INCHES[1])
    with open_plots(path, 1, inches=inches, dpi=_DPI, across=len(models), share_x=False) as axes:
        for plot, model in zip(np.atleast_1d(axes).flatten(), models, strict=True):
            plot.plot(model.minutes, model.values, color="#4c78a8", marker="o", markersize=4, linewidth=1.2)
            plot.set_xscale("log", base=2)
            plot.set_xticks(model.minutes, [f"{minutes:.3g}" for minutes in model.minutes])
            plot.minorticks_off()
            plot.set_title(f"{model.name}\ntwice the motion at the end: error {model.change:+.1f} %", fontsize=9)
            plot.set_xlabel("minutes of motion", fontsize=8)
            plot.set_ylabel(model.measure, fontsize=8)
            plot.tick_params(labelsize=7)
            plot.grid(alpha=0.25, linewidth=0.5)
