"""Every model that can be trained, by recipes of six steps that are validated at every other."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import tiny_denoiser
import tiny_infiller
import tiny_path
import tiny_stitcher
import tiny_transformer
import tiny_tweener

from priors.lstm_gmm.network import LstmGmmConfig
from priors.refiner import RefinerConfig
from priors.training.recipes import (
    denoiser,
    infiller,
    keyframe_timing,
    lstm_gmm,
    path,
    pose_transformer,
    refiner,
    stitcher,
    tweener,
)


@dataclass(frozen=True)
class Model:
    """A model, and a recipe of six steps that are validated at every other."""

    trainer: type
    recipe: Callable[[Path, Path, str], Any]
    """Of data, run folder and density."""


def _density(data, out, prior):
    settings = lstm_gmm.TrainingSettings(steps=6, batch=4, window=20)
    return lstm_gmm.DensityRecipe(
        data,
        out,
        config=LstmGmmConfig(width=8, components=2),
        settings=settings,
        device="cpu",
        validate_steps=2,
        starts=4,
    )


def _refiner(data, out, prior):
    settings = refiner.AdversarialSettings(
        steps=6,
        window=10,
        batch=4,
        warm_up=1,
        head_start=1,
        critic_updates=1,
        history=8,
        critic_width=6,
        critic_around=1,
    )
    config = RefinerConfig(width=6, memory=5, lookahead=1, joints=("hips", "rightToes"))
    return refiner.RefinerRecipe(
        data,
        out,
        density=prior,
        config=config,
        settings=settings,
        samples=6,
        judged=2,
        seconds=1.2,
        report_steps=2,
        validate_steps=2,
    )


def _windowed(recipe, config):
    def made(data, out, prior):
        usual = recipe(data, out, config=config, validate_steps=2)
        return replace(usual, settings=replace(usual.settings, steps=6, batch=3, window=32))

    return made


def _timing(data, out, prior):
    settings = keyframe_timing.KeyframeTimingSettings(steps=6)
    return keyframe_timing.KeyframeTimingRecipe(data, out, settings=settings, validate_steps=2)


MODELS = {
    "lstm-gmm": Model(lstm_gmm.DensityTrainer, _density),
    "refiner": Model(refiner.AdversarialTrainer, _refiner),
    "denoiser": Model(denoiser.DenoiserTrainer, _windowed(denoiser.DenoiserRecipe, tiny_denoiser.CONFIG)),
    "pose-transformer": Model(
        pose_transformer.PoseTransformerTrainer,
        _windowed(pose_transformer.PoseTransformerRecipe, tiny_transformer.CONFIG),
    ),
    "infiller": Model(infiller.InfillerTrainer, _windowed(infiller.InfillerRecipe, tiny_infiller.CONFIG)),
    "keyframe-timing": Model(keyframe_timing.KeyframeTimingTrainer, _timing),
    "path": Model(path.PathTrainer, _windowed(path.PathRecipe, tiny_path.CONFIG)),
    "tweener": Model(tweener.TweenerTrainer, _windowed(tweener.TweenerRecipe, tiny_tweener.CONFIG)),
    "stitcher": Model(stitcher.StitcherTrainer, _windowed(stitcher.StitcherRecipe, tiny_stitcher.CONFIG)),
}
"""By the names of their commands."""


_QUICK = "lstm-gmm", "refiner", "path"  # trained and validated in about a second, and each by a trainer of another kind


def list_params(names: Iterable[str]) -> list:
    """Parameters of a test for these models: all but the quickest, one of each kind of trainer, are marked slow."""
    return [pytest.param(name, marks=() if name in _QUICK else pytest.mark.slow, id=name) for name in names]
