"""`mapctl train denoiser` and `mapctl train infiller`: models that learn from windows of clips."""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mapctl.commands.shared import outputs
from mapctl.commands.shared.threads import use_single_thread
from mapctl.commands.train import checks

if TYPE_CHECKING:
    from mapctl.commands.train import Train

_FOREIGN_OPTIONS = ("density", "components", "labels", "paper")
_SHAPE_OPTIONS = {"denoiser": ("width",), "infiller": ("architecture",)}
"""By model, the options that its network's shape has."""


def train_on_windows(given: "Train", say: Callable[[str], None]) -> Path:
    """Check, train, and return where the model lies."""
    wanted = build_window_request(given)
    outputs.check_folder(given.out)
    use_single_thread()
    return _import_run_module(given).train(wanted, say, warn=checks.warn)


def build_window_request(given: "Train") -> Any:
    """The options as the trainer takes them; RequestError for those that the model has not."""
    shape = _SHAPE_OPTIONS[given.model]
    others = tuple(name for names in _SHAPE_OPTIONS.values() for name in names if name not in shape)
    checks.check_options(given, model=_ARTICLES[given.model], foreign=(*_FOREIGN_OPTIONS, *others))
    usual = getattr(_import_run_module(given), f"{given.model.capitalize()}Request")(given.data, given.out)
    recipe = checks.select_given(given, "steps", "batch", "window", "seed", "learning_rate")
    return replace(
        usual,
        match=given.match or "",
        config=replace(usual.config, **checks.select_given(given, *shape)),
        settings=replace(usual.settings, bfloat16=given.bfloat16, **recipe),
        resume=given.resume,
        checkpoint_minutes=given.minutes_between_checkpoints,
        licence=given.licence,
        skip_first=given.skip_first,
        init=given.init,
        strict_data=given.strict_data,
    )


_ARTICLES: dict[str, str] = {"denoiser": "a denoiser", "infiller": "an infiller"}


def _import_run_module(given: "Train") -> Any:
    """The module of the model's runs; imported late, since it imports torch."""
    return import_module(f"priors.training.{given.model}_run")
