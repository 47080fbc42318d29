"""Benchmark of long free runs of a density: whether a character stops or diverges, and how often its pace changes."""

from collections.abc import Mapping
from dataclasses import asdict

import torch
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.generation.generate import GenerateSettings, initialise_generation, sample_pieces
from controllers.generation.pace_plan import plan_paces
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose, ground_speed, integrate_root
from mapctl.metrics.pace_changes import CHANGES, PaceChanges, count_pace_changes, measure_speed
from mapctl.metrics.states import summarise_states
from mapctl.protocols import Density


def benchmark_free_run(
    prior: Density, data: Mapping[str, float], *, runs: int = 8, frames: int = 10_000, seed: int = 0
) -> list[Row]:
    """Measure long free runs at temperature 1: a row each, and one of their means beside the training `data`'s values.

    A character that had stopped would show in its slowest second; one that had diverged in its largest feature, in
    standard deviations. Changes of pace are given for ten minutes.
    """
    rows, everything, changed = [], [], PaceChanges()
    for run in range(runs):
        features = _sample_free_run(prior, frames, seed + run)
        changes = _count_pace_changes(features)
        everything.append(features)
        changed += changes
        speed = ground_speed(features)
        seconds = speed[: len(speed) // PRIOR_FPS * PRIOR_FPS].unflatten(0, (-1, PRIOR_FPS)).mean(-1)
        rows.append(
            {
                "run": str(run),
                **summarise_states(features),
                "slowest_second_m_s": float(seconds.min()),
                "fastest_second_m_s": float(seconds.max()),
                "largest_feature_sigma": float(_standardise_features(prior, features).abs().max()),
                **_count_in_ten_minutes(asdict(changes), frames / PRIOR_FPS / 60),
            }
        )
    together = {
        **summarise_states(torch.cat(everything)),
        **_count_in_ten_minutes(asdict(changed), runs * frames / PRIOR_FPS / 60),
    }
    return [*rows, {"run": "all", **together}, {"run": "training data", **data}]


def summarise_held_changes(holds: Mapping[str, float]) -> dict[str, float]:
    """Summarise the changes of pace that a card tells of its clips as this table has them; nothing of what it does not
    tell."""
    told = zip(asdict(PaceChanges()), CHANGES.values(), strict=True)
    counts = {name: holds[words] for name, words in told if words in holds}
    return _count_in_ten_minutes(counts, holds["minutes"]) if counts else {}


def _count_pace_changes(features: Tensor) -> PaceChanges:
    ground, _ = integrate_root(features.double(), GroundPose.origin(torch.float64))
    return count_pace_changes(measure_speed(ground.numpy(), PRIOR_FPS))


def _count_in_ten_minutes(counts: Mapping[str, float], minutes: float) -> dict[str, float]:
    return {f"{name}_10min": 10 * count / minutes for name, count in counts.items()}


def _sample_free_run(prior: Density, frames: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    beginning = initialise_generation(prior, GenerateSettings(), None, generator)
    paces, sampled, count = plan_paces(beginning.prior, beginning.speed, generator), list[Tensor](), 0
    for piece in sample_pieces(beginning, generator, paces=paces, longest=frames):
        sampled.append(piece)
        count += len(piece)
        if count >= frames:
            break
    return torch.cat(sampled)[:frames]


def _standardise_features(prior: Density, features: Tensor) -> Tensor:
    size = LAYOUT.continuous
    return ((features - prior.feature_mean) / prior.feature_std)[..., :size]
