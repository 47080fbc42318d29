"""`mapctl train denoiser`: the options of `mapctl train` that a denoiser has, and the run."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.commands import outputs, training
from mapctl.commands.threads import compute_on_one

if TYPE_CHECKING:
    from mapctl.commands.train import Train
    from priors.training.denoiser_run import DenoiserRequest

_OF_OTHERS = ("density", "components", "labels", "paper", "architecture")


def run(given: "Train", say: Callable[[str], None]) -> Path:
    """Check, train, and return where the denoiser lies."""
    wanted = request(given)
    outputs.check_folder(given.out)
    compute_on_one()
    from priors.training import denoiser_run

    return denoiser_run.train(wanted, say)


def request(given: "Train") -> "DenoiserRequest":
    """The options as the trainer takes them; RequestError for those that a denoiser has not."""
    from priors.training.denoiser_run import DenoiserConfig, DenoiserRequest, DenoiserSettings

    training.check(given, model="a denoiser", foreign=_OF_OTHERS)
    config = replace(DenoiserConfig(), **training.asked(given, "width"))
    recipe = training.asked(given, "steps", "batch", "window", "seed", "learning_rate")
    settings = replace(DenoiserSettings(), bfloat16=given.bfloat16, **recipe)
    return DenoiserRequest(
        data=given.data, out=given.out, match=given.match or "", config=config, settings=settings,
        resume=given.resume, checkpoint_minutes=given.minutes_between_checkpoints, licence=given.licence,
        skip_first=given.skip_first, init=given.init,
    )  # fmt: skip
