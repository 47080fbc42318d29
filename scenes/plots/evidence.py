"""Picture of what gives motion away: shares of the evidence by joint and band, by moment, and accuracy by gait."""

from os import PathLike
from typing import Any

import numpy as np

from mapctl.metrics.realism import Explanation
from mapctl.metrics.realism.evidence.parts import BANDS, JOINTS
from mapctl.metrics.realism.evidence.shares import Share
from scenes.plots import open_plots

_SURE, _UNSURE, _FLOOR = "#4c78a8", "#c8d3e0", "#bbbbbb"
_REACH = 150  # per cent, the most that is drawn


def plot_explanation(explanation: Explanation, path: str | PathLike[str]) -> None:
    """Write a PNG; pale bars are no more than chance. RequestError without matplotlib."""
    with open_plots(path, 2, inches=(13, 11), dpi=90, across=2, share_x=False) as ((cells, joints), (others, gaits)):
        _draw_cells(cells, explanation)
        told = explanation.told_apart
        _draw_shares(joints, explanation.joints[:12], told, "joints")
        bars = [*explanation.bands, *explanation.inputs, *explanation.phases]
        _draw_shares(others, bars, told, "bands, inputs and moments of the step")
        _draw_gaits(gaits, explanation)


def _draw_cells(axes: Any, explanation: Explanation) -> None:
    shares = {share.name: 100 * share.share for share in explanation.cells}
    grid = np.array([[shares[f"{joint}, {band}"] for band in BANDS] for joint in JOINTS])
    most = max(float(np.abs(grid).max()), 1e-6)
    image = axes.imshow(grid, cmap="RdBu_r", vmin=-most, vmax=most, aspect="auto")
    axes.set_xticks(range(len(BANDS)), BANDS, rotation=45, ha="right")
    axes.set_yticks(range(len(JOINTS)), JOINTS, fontsize=8)
    verdict = f"told apart in {100 * explanation.accuracy:.0f} %, floor {100 * explanation.floor:.0f} %"
    axes.set_title(verdict if explanation.told_apart else f"{verdict}: no cause is named")
    axes.figure.colorbar(image, ax=axes, label="share of the evidence, %")


def _draw_shares(axes: Any, shares: list[Share], told: bool, title: str) -> None:
    places = range(len(shares))
    values = [100 * share.share for share in shares]
    reach = [100 * (share.high - share.share) for share in shares]
    colours = [_SURE if told and share.named else _UNSURE for share in shares]
    axes.barh(places, values, xerr=reach, color=colours, ecolor="#777777")
    axes.set_yticks(places, [share.name for share in shares])
    axes.invert_yaxis()
    left, right = axes.get_xlim()
    # Where there is no evidence its shares are of nothing, and their intervals without bounds
    axes.set(title=title, xlabel="share of the evidence, %", xlim=(max(left, -_REACH), min(right, _REACH)))


def _draw_gaits(axes: Any, explanation: Explanation) -> None:
    rows = explanation.gaits
    for offset, colour, name in ((-0.2, _SURE, "accuracy"), (0.2, _FLOOR, "floor")):
        heights = [100 * getattr(row, name) for row in rows]
        axes.bar([place + offset for place in range(len(rows))], heights, 0.4, color=colour, label=name)
    names = [f"{row.gait}\n{row.made_windows} and {row.mocap_windows}" for row in rows]
    axes.set_xticks(range(len(rows)), names, fontsize=8)
    axes.axhline(50, color="#777777", linewidth=0.8)
    axes.set(title="told apart by gait (windows of both sets)", ylabel="%", ylim=(0, 100))
    axes.legend(frameon=False)
