"""`mapctl train infiller`: what its run trains (see priors.training.window_run)."""

from dataclasses import dataclass, field
from pathlib import Path

from priors.infiller.network import InfillerConfig
from priors.training.gathering import Progress
from priors.training.recipes.infiller import InfillerSettings, InfillerTrainer, validate
from priors.training.window_run import ModelKind, WindowRequest
from priors.training.window_run import train as train_on_windows


@dataclass(frozen=True)
class InfillerRequest(WindowRequest[InfillerConfig, InfillerSettings]):
    """What to train an infiller on, and how."""

    config: InfillerConfig = field(default_factory=InfillerConfig)
    """The network."""
    settings: InfillerSettings = field(default_factory=InfillerSettings)
    """The recipe."""


def _format_shape(config: InfillerConfig) -> list[str]:
    usual = InfillerConfig.architecture
    return [] if config.architecture == usual else [f"--architecture {config.architecture}"]


KIND = ModelKind("infiller", InfillerTrainer, validate, _format_shape)


def train(
    request: InfillerRequest, progress: Progress = lambda line: None, *, warn: Progress = lambda line: None
) -> Path:
    """Train to the end of the recipe and write RUN/model.safetensors; returns its path. See `window_run.train`."""
    return train_on_windows(request, KIND, progress, warn=warn)
