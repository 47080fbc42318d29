"""What `mapctl train` checks of any model's options before its trainer is imported."""

import sys
from collections.abc import Collection
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from mapctl.commands.shared import options
from mapctl.errors import RequestError

if TYPE_CHECKING:
    from mapctl.commands.train import Train

_COUNTS = ("width", "components", "steps", "batch", "window")


def check_options(given: "Train", *, model: str, foreign: Collection[str] = (), on_gpu: bool = False) -> None:
    """RequestError for an option that a model has not, and for numbers that make no sense for any.

    `model` is as a message names it ("a refiner"), `foreign` are the fields of `Train` that are for others, and
    without `on_gpu` it is trained on the processor alone.
    """
    defaults = {option.name: option.default for option in fields(given)}
    for name in foreign:
        if getattr(given, name) != defaults[name]:
            raise RequestError(f"--{name.replace('_', '-')} is for other models; {model} has no such option")
    if given.device == "cuda" and not on_gpu:
        raise RequestError(f"{model} is trained on the processor; leave --device out")
    for name, value in select_given(given, *_COUNTS).items():
        if value < 1:
            raise RequestError(f"--{name} must be at least 1, got {value}")
    if given.seed is not None:
        options.check_seed(given.seed)
    if given.learning_rate is not None and not 0 < given.learning_rate < 1:
        raise RequestError(f"the learning rate must lie between 0 and 1, got {given.learning_rate:g}")
    if not given.minutes_between_checkpoints > 0:
        raise RequestError(f"minutes between checkpoints must be positive, got {given.minutes_between_checkpoints:g}")


def warn(line: str) -> None:
    """Say it where --quiet and redirected output do not hide it."""
    print(f"mapctl: {line}", file=sys.stderr, flush=True)


def select_given(given: "Train", *names: str, **renamed: str) -> dict[str, Any]:
    """The options among `names` that were given, for `replace`; `renamed` are those that a recipe calls otherwise, as
    in `rounds="steps"`.
    """
    options_of = {name: name for name in names} | renamed
    return {name: value for name, option in options_of.items() if (value := getattr(given, option)) is not None}
