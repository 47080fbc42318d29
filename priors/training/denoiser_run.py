"""`mapctl train denoiser`: what its run trains (see priors.training.window_run)."""

from dataclasses import dataclass, field
from pathlib import Path

from priors.denoiser.network import DenoiserConfig
from priors.training.gathering import Progress
from priors.training.recipes.denoiser import DenoiserSettings, DenoiserTrainer, validate
from priors.training.window_run import ModelKind, WindowRequest
from priors.training.window_run import train as train_on_windows


@dataclass(frozen=True)
class DenoiserRequest(WindowRequest[DenoiserConfig, DenoiserSettings]):
    """What to train a denoiser on, and how."""

    config: DenoiserConfig = field(default_factory=DenoiserConfig)
    """The network."""
    settings: DenoiserSettings = field(default_factory=DenoiserSettings)
    """The recipe."""


def _format_shape(config: DenoiserConfig) -> list[str]:
    return [] if config.width == DenoiserConfig.width else [f"--width {config.width}"]


KIND = ModelKind("denoiser", DenoiserTrainer, validate, _format_shape)


def train(
    request: DenoiserRequest, progress: Progress = lambda line: None, *, warn: Progress = lambda line: None
) -> Path:
    """Train to the end of the recipe and write RUN/model.safetensors; returns its path. See `window_run.train`."""
    return train_on_windows(request, KIND, progress, warn=warn)
