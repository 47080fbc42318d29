"""How good models are by how much motion they were trained on: a table and a picture of sets of different shares."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapctl.commands.shared import outputs
from mapctl.commands.shared.tables import print_table
from mapctl.commands.train.whole_set.summary import find_weights, read_set
from mapctl.errors import RequestError
from priors.training.bundled.weights import Finished
from scenes.plots.scaling import Scaling, plot_scaling

_COLUMNS = (
    *("model", "minutes of motion", "minutes of a core", "steps"),
    *("quality", "that is", "error above that of the most motion, %"),
)


def print_scaling(sets: Sequence[Path], picture: Path | None) -> int:
    """Print each model's quality in each set by minutes of motion, and by how much its error changes with twice the
    motion, over all sets and at the end; draw that if a picture is asked for. Returns the exit status.

    RequestError where no model is in two sets that were trained on different amounts of motion and measured on the
    same unseen clips.
    """
    if len(sets) < 2:
        raise RequestError("--by-motion compares two sets at least")
    if picture is not None:
        outputs.check_picture(picture, given=sets[0])
    models = _collect(sets)
    if not models:
        raise RequestError(
            "no model is in two of these sets, by other amounts of motion and with the same unseen clips"
        )
    rows = [row for name, sizes in models.items() for row in _list_rows(name, sizes)]
    print_table(_COLUMNS, rows)
    lasts = {name: _fit_change(_select_most(sizes)) for name, sizes in models.items()}
    changes = [(name, _fit_change(sizes), lasts[name]) for name, sizes in models.items()]
    print_table(
        ("model", "error changes with twice the motion by, %", "between the two sets of most motion, %"), changes
    )
    if picture is not None:
        plot_scaling([_make_plot(name, sizes, lasts[name]) for name, sizes in models.items()], picture)
        print(f"wrote {picture}")
    return 0


def _collect(sets: Sequence[Path]) -> dict[str, list[Finished]]:
    """By name the models that are in several sets, from least motion to most."""
    found: dict[str, list[Finished]] = {}
    for folder in sets:
        for model in read_set(find_weights(folder)):
            if math.isfinite(model.minutes_of_motion) and math.isfinite(model.log_error):
                found.setdefault(model.name, []).append(model)
    kept = {}
    for name, models in found.items():
        alike = [model for model in models if model.held_out == models[0].held_out]
        if len({model.minutes_of_motion for model in alike}) > 1:
            kept[name] = sorted(alike, key=lambda model: model.minutes_of_motion)
    return kept


def _list_rows(name: str, sizes: Sequence[Finished]) -> list[list[object]]:
    return [
        [name, model.minutes_of_motion, model.minutes, model.steps, *model.quality, sizes[-1].find_change(model)]
        for model in sizes
    ]


def _select_most(sizes: Sequence[Finished]) -> list[Finished]:
    """Select those of the two largest amounts of motion: curves flatten, and what more would bring shows at the end."""
    most = sorted({model.minutes_of_motion for model in sizes})[-2:]
    return [model for model in sizes if model.minutes_of_motion in most]


def _fit_change(sizes: Sequence[Finished]) -> float:
    """Percent by which the error changes where there is twice the motion: the least-squares line of logarithms."""
    doublings = [math.log2(model.minutes_of_motion) for model in sizes]
    slope = np.polyfit(doublings, [model.log_error for model in sizes], 1)[0]
    return 100 * math.expm1(float(slope))


def _make_plot(name: str, sizes: Sequence[Finished], change: float) -> Scaling:
    values = [model.quality[0] for model in sizes]
    return Scaling(name, sizes[0].quality[1], tuple(model.minutes_of_motion for model in sizes), tuple(values), change)
