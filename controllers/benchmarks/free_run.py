"""Benchmark of long free runs of a density: whether a character stops or diverges."""

from collections.abc import Mapping

import torch
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.generation.generate import GenerateSettings, initialise_generation
from mapctl.features import LAYOUT, PRIOR_FPS, ground_speed
from mapctl.metrics.states import summarise_states
from mapctl.protocols import Density


def benchmark_free_run(
    prior: Density, data: Mapping[str, float], *, runs: int = 8, frames: int = 10_000, seed: int = 0
) -> list[Row]:
    """Measure long free runs at temperature 1: a row each, and one of their means beside the training `data`'s values.

    A character that had stopped would show in its slowest second; one that had diverged in its largest feature, in
    standard deviations.
    """
    rows, everything = [], []
    for run in range(runs):
        features = _sample_free_run(prior, frames, seed + run)
        everything.append(features)
        pace = ground_speed(features)
        seconds = pace[: len(pace) // PRIOR_FPS * PRIOR_FPS].unflatten(0, (-1, PRIOR_FPS)).mean(-1)
        rows.append(
            {
                "run": str(run),
                **summarise_states(features),
                "slowest_second_m_s": float(seconds.min()),
                "fastest_second_m_s": float(seconds.max()),
                "largest_feature_sigma": float(_standardise_features(prior, features).abs().max()),
            }
        )
    return [*rows, {"run": "all", **summarise_states(torch.cat(everything))}, {"run": "training data", **data}]


def _sample_free_run(prior: Density, frames: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    conditioned, state, _ = initialise_generation(prior, GenerateSettings(), None, generator)
    return conditioned.sample(state, frames, generator)[0][0]


def _standardise_features(prior: Density, features: Tensor) -> Tensor:
    size = LAYOUT.continuous
    return ((features - prior.feature_mean) / prior.feature_std)[..., :size]
