"""`mapctl train refiner`: the options of `mapctl train` that a refiner has, and the run."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.commands.shared import outputs
from mapctl.commands.shared.threads import use_single_thread
from mapctl.commands.train import checks

if TYPE_CHECKING:
    from mapctl.commands.train import Train
    from priors.training.refiner_run import RefinerRequest

_FOREIGN_OPTIONS = ("width", "components", "learning_rate", "labels", "init", "skip_first", "architecture")


def train_refiner(given: "Train", say: Callable[[str], None]) -> Path:
    """Check, train, and return where the refiner lies."""
    wanted = build_refiner_request(given)
    outputs.check_folder(given.out)
    use_single_thread()
    from priors.training import refiner_run

    return refiner_run.train(wanted, say, warn=checks.warn)


def build_refiner_request(given: "Train") -> "RefinerRequest":
    """The options as the trainer takes them; RequestError for those that a refiner has not."""
    from priors.training.recipes.refiner import PAPER, AdversarialSettings
    from priors.training.refiner_run import RefinerConfig, RefinerRequest

    checks.check_options(given, model="a refiner", foreign=_FOREIGN_OPTIONS)
    config, settings = PAPER if given.paper else (RefinerConfig(), AdversarialSettings())
    recipe = checks.select_given(given, "batch", "window", "seed", rounds="steps")
    return RefinerRequest(
        data=given.data,
        out=given.out,
        density=given.density,
        match=given.match,
        config=config,
        settings=replace(settings, bfloat16=given.bfloat16, **recipe),
        resume=given.resume,
        checkpoint_minutes=given.minutes_between_checkpoints,
        licence=given.licence,
        strict_data=given.strict_data,
    )
