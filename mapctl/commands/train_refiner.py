"""`mapctl train refiner`: the options of `mapctl train` that a refiner has, and the run."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.commands import options, outputs
from mapctl.commands.threads import compute_on_one
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from mapctl.commands.train import Train
    from priors.training.refiner_run import RefinerRequest

_OF_A_DENSITY = ("width", "components", "learning_rate", "labels", "init", "skip_first")


def run(given: "Train", say: Callable[[str], None]) -> Path:
    """Check, train, and return where the refiner lies."""
    wanted = request(given)
    outputs.check_folder(given.out)
    compute_on_one()
    from priors.training import refiner_run

    return refiner_run.train(wanted, say)


def request(given: "Train") -> "RefinerRequest":
    """The options as the trainer takes them; RequestError for those that only a density has."""
    from priors.training.refiner import PAPER, AdversarialSettings
    from priors.training.refiner_run import RefinerConfig, RefinerRequest

    defaults = {option.name: option.default for option in fields(given)}
    for name in _OF_A_DENSITY:
        if getattr(given, name) != defaults[name]:
            raise RequestError(f"--{name.replace('_', '-')} is for lstm-gmm; a refiner has no such option")
    if given.device == "cuda":
        raise RequestError("a refiner is trained on the processor; leave --device out")
    numbers = {"rounds": given.steps, "batch": given.batch, "window": given.window, "seed": given.seed}
    for name, value in numbers.items():
        if name == "seed" and value is not None:
            options.check_seed(value)
        elif value is not None and value < 1:
            raise RequestError(f"--{'steps' if name == 'rounds' else name} must be at least 1, got {value}")
    if not given.minutes_between_checkpoints > 0:
        raise RequestError(f"minutes between checkpoints must be positive, got {given.minutes_between_checkpoints:g}")
    config, settings = PAPER if given.paper else (RefinerConfig(), AdversarialSettings())
    changed = {name: value for name, value in numbers.items() if value is not None}
    return RefinerRequest(
        data=given.data, out=given.out, density=given.density, match=given.match, config=config,
        settings=replace(settings, bfloat16=given.bfloat16, **changed), resume=given.resume,
        checkpoint_minutes=given.minutes_between_checkpoints, licence=given.licence,
    )  # fmt: skip
