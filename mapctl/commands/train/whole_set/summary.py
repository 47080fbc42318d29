"""What is told of a set of models: a table, its size, its curves, and two sets beside each other."""

from importlib.util import find_spec
from pathlib import Path

from mapctl.commands.shared import exit_status
from mapctl.commands.shared.tables import print_table
from mapctl.errors import RequestError
from priors.training.bundled.models import RECIPES, list_models
from priors.training.bundled.weights import MOST_BYTES, Finished, read_finished
from scenes.plots.training import Curve, plot_models

_MEGABYTE = 1e6


def find_weights(out: Path) -> Path:
    """The folder of weights of a set, or the folder itself where it is one. RequestError where there is none."""
    for folder in (out / "weights", out):
        if folder.is_dir() and list_names(folder):
            return folder
    raise RequestError(f"{out} holds no set of models: neither weights/ nor NAME.safetensors with its card")


def list_names(folder: Path) -> list[str]:
    """Names of the models in a folder of weights, in the order in which they are trained."""
    found = {file.stem for file in folder.glob("*.safetensors") if file.with_suffix(".json").is_file()}
    usual = [model.name for model in list_models()]
    return [name for name in usual if name in found] + sorted(found - set(usual))


def read_set(folder: Path) -> list[Finished]:
    """All models of a folder of weights; CheckpointError for one that is damaged."""
    return [read_finished(name, folder / f"{name}.safetensors") for name in list_names(folder)]


def print_set(folder: Path) -> int:
    """Print what training took, what came of it and how large it is; returns the bytes of all."""
    models = read_set(folder)
    rows = [
        [model.name, model.minutes, model.steps, *model.quality, model.size / _MEGABYTE, model.why] for model in models
    ]
    print_table(["model", "minutes of a core", "steps", "quality", "that is", "MB", "ended because"], rows)
    total = sum(model.size for model in models)
    over = "" if total <= MOST_BYTES else f", {(total - MOST_BYTES) / _MEGABYTE:.1f} MB too much"
    count = "1 model" if len(models) == 1 else f"{len(models)} models"
    print(f"{count}, {total / _MEGABYTE:.1f} MB of {MOST_BYTES / _MEGABYTE:g} MB{over}")
    return total


def print_comparison(first: Path, second: Path, *, percent: float) -> int:
    """Print each model's quality in both sets and by how much the second one's error is larger; returns the exit
    status."""
    one, other = ({model.name: model for model in read_set(find_weights(out))} for out in (first, second))
    shared = [name for name in one if name in other and one[name].card.kind == other[name].card.kind]
    if not shared:
        raise RequestError(f"{first} and {second} have no model in common")
    rows = [_compare(name, one[name], other[name]) for name in shared]
    print_table(["model", str(first), str(second), "that is", "error changes by, %", "unseen clips"], rows)
    for out, own, others in ((first, one, other), (second, other, one)):
        if lacking := [name for name in own if name not in others]:
            print(f"only in {out}: {', '.join(lacking)}")
    apart = [row for row in rows if not abs(float(str(row[4]))) <= percent]
    if apart:
        print(f"more than {percent:g} % apart: {', '.join(str(row[0]) for row in apart)}")
    return exit_status.NOT_SATISFIED if apart else 0


def _compare(name: str, one: Finished, other: Finished) -> list[object]:
    same = one.held_out == other.held_out
    return [
        name,
        one.quality[0],
        other.quality[0],
        one.quality[1],
        one.find_change(other),
        "same" if same else "others",
    ]


def plot_set(folder: Path, path: Path) -> bool:
    """Draw one curve of validations for each model of a folder of weights; False, and nothing, without matplotlib or
    curves."""
    if find_spec("matplotlib") is None:
        return False
    curves = [curve for model in read_set(folder) if (curve := _find_curve(model)) is not None]
    if curves:
        plot_models(curves, path)
    return bool(curves)


def _find_curve(model: Finished) -> Curve | None:
    recipe, rows = RECIPES.get(model.card.kind), model.card.training.get("curve", [])
    if recipe is None:
        return None
    points = [(int(row[recipe.counter]), recipe.find_headline(row)) for row in rows if recipe.counter in row]
    points = [point for point in points if abs(point[1]) < float("inf")]
    if not points:
        return None
    steps, values = zip(*points, strict=True)
    mark = model.card.training.get("ended", {}).get("decay_from")
    return Curve(f"{model.name}: {recipe.headline}", False, steps, values, mark)
