"""Plots of how a model was trained: each loss and each measure of held-out clips over the steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from mapctl.errors import RequestError
from scenes.plots import open_plots

_ACROSS, _INCHES, _DPI = 4, (3.6, 2.4), 100
_MOST = 40  # plots of a picture; a run tells of thirty things at most
_LOGARITHMIC = 20.0  # times as large at one end as at the other, from which on a logarithmic scale shows more
_TRAINING, _VALIDATION = "#4c78a8", "#e45756"


@dataclass(frozen=True)
class Curve:
    """One loss or measure."""

    name: str
    """As the run calls it."""
    training: bool
    """Whether it is a loss of training; else it is measured on held-out clips."""
    steps: tuple[int, ...]
    """At which it was told."""
    values: tuple[float, ...]
    """At these steps, finite."""
    mark: int | None = None
    """Step from which the learning rate falls, drawn as a line, where that was decided in the run."""


def plot_curves(curves: Sequence[Curve], path: str | PathLike[str], *, counter: str, title: str) -> None:
    """Write a PNG with a plot for each name, in which training is blue and validation red.

    RequestError without matplotlib or curves.
    """
    names = list(dict.fromkeys(curve.name for curve in curves))[:_MOST]
    if not names:
        raise RequestError("there are no losses to draw yet")
    across = min(_ACROSS, len(names))
    down = -(-len(names) // across)
    inches = (_INCHES[0] * across, _INCHES[1] * down + 0.5)
    with open_plots(path, down, inches=inches, dpi=_DPI, across=across) as axes:
        plots = np.atleast_1d(axes).flatten()
        for plot, name in zip(plots, names, strict=False):
            _draw(plot, name, [curve for curve in curves if curve.name == name])
        for plot in plots[len(names) :]:
            plot.set_axis_off()
        for plot in plots[max(0, len(names) - across) : len(names)]:
            plot.set_xlabel(counter)
            plot.tick_params(labelbottom=True)
        plots[0].figure.suptitle(f"{title}: training blue, validation red", fontsize=11)


def plot_models(curves: Sequence[Curve], path: str | PathLike[str]) -> None:
    """Write a PNG with a plot for each of several models, each over its own steps.

    RequestError without matplotlib or curves.
    """
    if not curves:
        raise RequestError("there are no curves to draw yet")
    across = min(_ACROSS, len(curves))
    down = -(-len(curves) // across)
    inches = (_INCHES[0] * across, _INCHES[1] * down + 0.5)
    with open_plots(path, down, inches=inches, dpi=_DPI, across=across, share_x=False) as axes:
        plots = np.atleast_1d(axes).flatten()
        for plot, curve in zip(plots, curves, strict=False):
            _draw(plot, curve.name, [curve])
        for plot in plots[len(curves) :]:
            plot.set_axis_off()
        plots[0].figure.suptitle("Unseen clips over the steps; dashed: the learning rate begins to fall", fontsize=11)


def _draw(plot: Any, name: str, curves: Sequence[Curve]) -> None:
    for curve in curves:
        few = len(curve.steps) < 60
        plot.plot(
            curve.steps,
            curve.values,
            color=_TRAINING if curve.training else _VALIDATION,
            linewidth=1.2,
            marker="o" if few else None,
            markersize=3,
        )
        if curve.mark is not None:
            plot.axvline(curve.mark, color="0.4", linewidth=0.8, linestyle="--")
    values = [value for curve in curves for value in curve.values]
    plot.set_title(name, fontsize=9)
    plot.tick_params(labelsize=7)
    plot.grid(alpha=0.25, linewidth=0.5)
    if min(values) > 0 and math.isfinite(max(values)) and max(values) > _LOGARITHMIC * min(values):
        plot.set_yscale("log")
