"""`mapctl train infiller`: the options of `mapctl train` that an infiller has, and the run."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.commands import outputs, training
from mapctl.commands.threads import compute_on_one

if TYPE_CHECKING:
    from mapctl.commands.train import Train
    from priors.training.infiller_run import InfillerRequest

_OF_OTHERS = ("density", "components", "labels", "paper", "width")


def run(given: "Train", say: Callable[[str], None]) -> Path:
    """Check, train, and return where the infiller lies."""
    wanted = request(given)
    outputs.check_folder(given.out)
    compute_on_one()
    from priors.training import infiller_run

    return infiller_run.train(wanted, say)


def request(given: "Train") -> "InfillerRequest":
    """The options as the trainer takes them; RequestError for those that an infiller has not."""
    from priors.training.infiller_run import InfillerConfig, InfillerRequest, InfillerSettings

    training.check(given, model="an infiller", foreign=_OF_OTHERS)
    recipe = training.asked(given, "steps", "batch", "window", "seed", "learning_rate")
    settings = replace(InfillerSettings(), bfloat16=given.bfloat16, **recipe)
    config = replace(InfillerConfig(), **training.asked(given, "architecture"))
    return InfillerRequest(
        data=given.data, out=given.out, match=given.match or "", config=config, settings=settings,
        resume=given.resume, checkpoint_minutes=given.minutes_between_checkpoints, licence=given.licence,
        skip_first=given.skip_first, init=given.init,
    )  # fmt: skip
