"""`mapctl train denoiser`: the options of `mapctl train` that a denoiser has, and the run."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mapctl.commands import options, outputs
from mapctl.commands.threads import compute_on_one
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from mapctl.commands.train import Train
    from priors.training.denoiser_run import DenoiserRequest

_OF_OTHERS = ("density", "components", "labels", "init", "paper")


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

    defaults = {option.name: option.default for option in fields(given)}
    for name in _OF_OTHERS:
        if getattr(given, name) != defaults[name]:
            raise RequestError(f"--{name} is for other models; a denoiser has no such option")
    if given.device == "cuda":
        raise RequestError("a denoiser is trained on the processor; leave --device out")
    numbers = {"steps": given.steps, "batch": given.batch, "window": given.window, "seed": given.seed}
    for name, value in numbers.items():
        if name == "seed" and value is not None:
            options.check_seed(value)
        elif value is not None and value < 1:
            raise RequestError(f"--{name} must be at least 1, got {value}")
    if given.learning_rate is not None and not 0 < given.learning_rate < 1:
        raise RequestError(f"the learning rate must lie between 0 and 1, got {given.learning_rate:g}")
    if not given.minutes_between_checkpoints > 0:
        raise RequestError(f"minutes between checkpoints must be positive, got {given.minutes_between_checkpoints:g}")
    config = DenoiserConfig() if given.width is None else DenoiserConfig(width=given.width)
    changed = {name: value for name, value in (numbers | {"learning_rate": given.learning_rate}).items() if value}
    changed |= {"seed": given.seed} if given.seed is not None else {}
    return DenoiserRequest(
        data=given.data, out=given.out, match=given.match or "", config=config,
        settings=replace(DenoiserSettings(), bfloat16=given.bfloat16, **changed), resume=given.resume,
        checkpoint_minutes=given.minutes_between_checkpoints, licence=given.licence, skip_first=given.skip_first,
    )  # fmt: skip
