"""`mapctl train denoiser` and `mapctl train infiller`: models that learn from windows of clips."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapctl.commands.shared import outputs
from mapctl.commands.shared.threads import compute_on_one
from mapctl.commands.train import checks

if TYPE_CHECKING:
    from mapctl.commands.train import Train

_OF_OTHERS = ("density", "components", "labels", "paper")
_SHAPES = {"denoiser": ("width",), "infiller": ("architecture",)}
"""By model, the options that its network's shape has."""


def run(given: "Train", say: Callable[[str], None]) -> Path:
    """Check, train, and return where the model lies."""
    wanted = request(given)
    outputs.check_folder(given.out)
    compute_on_one()
    return _runs(given).train(wanted, say, warn=checks.warn)


def request(given: "Train") -> Any:
    """The options as the trainer takes them; RequestError for those that the model has not."""
    shape = _SHAPES[given.model]
    others = tuple(name for names in _SHAPES.values() for name in names if name not in shape)
    checks.check(given, model=_ARTICLES[given.model], foreign=(*_OF_OTHERS, *others))
    usual = getattr(_runs(given), f"{given.model.capitalize()}Request")(given.data, given.out)
    recipe = checks.asked(given, "steps", "batch", "window", "seed", "learning_rate")
    return replace(
        usual,
        match=given.match or "",
        config=replace(usual.config, **checks.asked(given, *shape)),
        settings=replace(usual.settings, bfloat16=given.bfloat16, **recipe),
        resume=given.resume,
        checkpoint_minutes=given.minutes_between_checkpoints,
        licence=given.licence,
        skip_first=given.skip_first,
        init=given.init,
        strict_data=given.strict_data,
    )


_ARTICLES: dict[str, str] = {"denoiser": "a denoiser", "infiller": "an infiller"}


def _runs(given: "Train") -> Any:
    """The module of the model's runs; imported late, since it imports torch."""
    return import_module(f"priors.training.{given.model}_run")
