"""Plots of how a run was trained: of a run folder, finished or not, or of any model whose card holds its curve."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mapctl.errors import RequestError
from priors import checkpoints
from priors.training.record.losses_file import NAME, TRAINING, LossRow, read_losses
from priors.training.record.watching import Row, RunStart, Watcher
from scenes.plots.training import Curve, plot_curves

_COUNTERS = ("step", "round")


def plot_run(name: str, path: Path) -> int:
    """Draw the losses and validations of a run folder or model as a PNG; returns how many curves there are.

    RequestError where there is nothing to draw.
    """
    curves, counter = read_curves(name)
    plot_curves(curves, path, counter=counter, title=name)
    return len(curves)


def read_curves(name: str) -> tuple[list[Curve], str]:
    """The curves of a run folder's losses.csv, else those of its checkpoint or of a model's card; and what a step is
    called. RequestError where there are none.
    """
    folder = Path(name)
    if folder.is_dir():
        if rows := read_losses(folder / NAME):
            head = (folder / NAME).read_text(encoding="utf-8").partition(",")[0]
            return make_curves(rows), head
        if not (curve := _read_checkpoint_curve(folder)):
            raise RequestError(
                f"{folder} holds no losses to draw: neither {NAME} nor a checkpoint or model with a training curve"
            )
    elif not (curve := checkpoints.read_card(checkpoints.locate(name).with_suffix(".json")).training.get("curve")):
        raise RequestError(f"the card of {name} holds no training curve to draw")
    return make_curves(_list_rows(curve)), _find_counter(curve[0])


def make_curves(rows: Iterable[LossRow]) -> list[Curve]:
    """One curve for each loss and each measure, in the order in which they come."""
    found: dict[tuple[str, bool], list[tuple[int, float]]] = {}
    for row in rows:
        for name, value in row.values.items():
            found.setdefault((name, row.part == TRAINING), []).append((row.step, value))
    return [
        Curve(name, training, tuple(step for step, _ in points), tuple(value for _, value in points))
        for (name, training), points in found.items()
    ]


class CurvePlotter(Watcher):
    """Draws a run's curves anew at each validation."""

    def __init__(self, path: Path):
        self._path = path

    def begin(self, start: RunStart) -> None:
        """Nothing is drawn before the first validation."""

    def see_validation(self, step: int, measures: Row) -> None:
        """Draw what losses.csv holds by now."""
        if read_losses(self._path.parent / NAME):
            plot_run(str(self._path.parent), self._path)


def _read_checkpoint_curve(folder: Path) -> list[Mapping[str, Any]]:
    """The validations of a run that has no losses.csv: one of an older version. Empty where there are none."""
    for file, keys in (("checkpoint.json", ("curve",)), ("model.json", ("training", "curve"))):
        try:
            found = json.loads((folder / file).read_text(encoding="utf-8"))
            for key in keys:
                found = found[key]
            if found and all(isinstance(row, dict) and _find_counter(row) in row for row in found):
                return found
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return []


def _list_rows(curve: Iterable[Mapping[str, Any]]) -> list[LossRow]:
    return [
        LossRow(
            int(row[_find_counter(row)]),
            "validation",
            {name: float(v) for name, v in row.items() if isinstance(v, int | float) and name not in _COUNTERS},
        )
        for row in curve
    ]


def _find_counter(row: Mapping[str, Any]) -> str:
    return next((name for name in _COUNTERS if name in row), _COUNTERS[0])
