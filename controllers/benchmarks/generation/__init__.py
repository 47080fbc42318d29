"""Benchmark of the refiner and the foot clean-up: Wang et al. 2019, figure 12, by measures instead of votes."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from controllers.benchmarks.shared.bones import put_on_generated_bones
from controllers.benchmarks.shared.tables import Row, average_rows
from controllers.generation.foot_cleanup import FootCleanupSettings
from controllers.generation.generate import SIGMA_PLANTED, GenerateSettings, generate, sample_stratified_starts
from mapctl.errors import RequestError
from mapctl.metrics import measure
from mapctl.metrics.realism import (
    GaitSpread,
    RealismSettings,
    measure_diversity,
    measure_gait_spread,
    measure_realism,
    spread_ratios,
)
from mapctl.motion import Motion
from mapctl.protocols import Density, Refiner

_MEASURES = ("contact_speed_cm_s", "skate_cm_s", "jitter_m_s3", "penetration_cm", "float_cm", "speed_m_s")


@dataclass(frozen=True)
class GenerationBenchmarkSettings:
    """Size of the benchmark."""

    count: int = 48
    """Number of clips of each variant."""
    seconds: float = 10.0
    """Length of each clip, seconds."""
    samples_per_start: int = 8
    """Number of samples from one initial state, whose pairwise distance is the diversity."""
    sample_seconds: float = 4.0
    """Length of each of these samples, seconds."""
    running: float = 1.9
    """Mean speed from which a clip counts as a run, m/s."""
    seed: int = 0
    """Seed of initial states and samples, the same for every variant."""
    realism: RealismSettings = field(default_factory=RealismSettings)
    """Settings of the classifier."""


@dataclass(frozen=True)
class Variant:
    """A way of generating motion."""

    name: str
    """Name in the table."""
    prior: Density
    """Density that is drawn from."""
    refiner: Refiner | None
    """Refiner of the draws; None leaves it out."""
    foot_cleanup: FootCleanupSettings | None
    """Settings of the foot clean-up; None leaves it out."""
    sigma_planted: float | None = None
    """Sigma of a planted toe's speed, m/s, given which frames are sampled; None samples them as they come."""

    def settings(self) -> GenerateSettings:
        """Return what it is sampled with."""
        return GenerateSettings(foot_cleanup=self.foot_cleanup, sigma_planted=self.sigma_planted)


def benchmark_generation(
    prior: Density,
    refiner: Refiner | None,
    mocap: Sequence[Motion],
    settings: GenerationBenchmarkSettings | None = None,
    *,
    densities: Mapping[str, Density] | None = None,
    refiners: Mapping[str, Refiner] | None = None,
) -> list[Row]:
    """Measure a row for mocap and one for each variant, walks and runs apart, then both together; other densities, and
    other refiners of the prior, are variants by their names.

    `mocap` is canonical motion held out from training. RequestError where it holds no walk or no run.
    """
    settings = settings or GenerationBenchmarkSettings()
    kinds = _split_by_kind(mocap, settings)
    if not all(kinds.values()):
        raise RequestError("the table needs mocap of walking and of running")
    rows = [
        {"motion": kind, "variant": "mocap", "clips": len(clips), **_mean_measures(clips)}
        for kind, clips in kinds.items()
    ]
    spread = measure_gait_spread(mocap)
    for variant in list_variants(prior, refiner, densities or {}, refiners or {}):
        clips, cost = _time_clips(variant, settings)
        for kind, kind_clips in _split_by_kind(clips, settings).items():
            rows.append(
                {"motion": kind, "variant": variant.name, "clips": len(kind_clips), **_mean_measures(kind_clips)}
            )
        rows.append(
            {
                "motion": "both",
                "variant": variant.name,
                "clips": len(clips),
                "ms_per_frame": cost,
                **_measure_realism(clips, mocap, settings),
                **_measure_diversity(variant, settings),
                **_compare_gait_spreads(clips, spread),
            }
        )
    return rows


def list_variants(
    prior: Density, refiner: Refiner | None, densities: Mapping[str, Density], refiners: Mapping[str, Refiner]
) -> list[Variant]:
    """Each density, and the prior with each refiner, without and with footing; densities also with planted samples."""
    ours: dict[str, Refiner | None] = {"density": None}
    ours |= {} if refiner is None else {"density, refiner": refiner}
    ours |= {f"density, {name}": each for name, each in refiners.items()}
    made = [(name, prior, each) for name, each in ours.items()]
    made += [(name, each, None) for name, each in densities.items()]
    ways = (("", None, None), (", planted", None, SIGMA_PLANTED), (", footing", FootCleanupSettings(), None))
    return [
        Variant(f"{name}{suffix}", density, each, footing, planted)
        for name, density, each in made
        for suffix, footing, planted in ways
        if each is None or planted is None
    ]


def _time_clips(variant: Variant, settings: GenerationBenchmarkSettings) -> tuple[list[Motion], float]:
    """Generate clips, and measure milliseconds of processor time a frame."""
    began = time.process_time()
    clips = generate_clips(variant, settings.count, settings.seconds, settings.seed)
    spent = time.process_time() - began
    return clips, 1000 * spent / sum(clip.num_frames for clip in clips)


def generate_clips(variant: Variant, count: int, seconds: float, seed: int) -> list[Motion]:
    """Generate so many clips of a length from initial states that cover those of the prior; the seed is that of the
    first clip."""
    variant_settings = variant.settings()
    starts = sample_stratified_starts(variant.prior, count, torch.Generator().manual_seed(seed))
    return [
        _generate_clip(variant, replace(variant_settings, start=start), seconds, seed + number)
        for number, start in enumerate(starts)
    ]


def _generate_clip(variant: Variant, variant_settings: GenerateSettings, seconds: float, seed: int) -> Motion:
    generator = torch.Generator().manual_seed(seed)
    return generate(
        variant.prior, seconds=seconds, generator=generator, settings=variant_settings, refiner=variant.refiner
    ).motion


def _compare_gait_spreads(clips: Sequence[Motion], data: Mapping[str, GaitSpread]) -> Row:
    """Compute the standard deviations of step length, speed and turning as ratios to the data's."""
    return {f"{name}_spread": ratio for name, ratio in spread_ratios(measure_gait_spread(clips), data).items()}


def _measure_diversity(variant: Variant, settings: GenerationBenchmarkSettings) -> Row:
    """Measure the average pairwise distance of samples from one initial state, mean over a few."""
    found, starts = [], len(variant.prior.initial_states.speed)
    for start in range(0, starts, max(1, starts // 4)):
        variant_settings = replace(variant.settings(), start=start)
        samples = [
            _generate_clip(variant, variant_settings, settings.sample_seconds, settings.seed + k)
            for k in range(settings.samples_per_start)
        ]
        found.append(measure_diversity(samples).root_aligned_cm)
    return {"diversity_cm": sum(found) / len(found)}


def _measure_realism(clips: Sequence[Motion], mocap: Sequence[Motion], settings: GenerationBenchmarkSettings) -> Row:
    generator = torch.Generator().manual_seed(settings.seed)
    real = [put_on_generated_bones(clip) for clip in mocap]
    found = measure_realism(clips, real, generator=generator, settings=settings.realism)
    return {
        "told_apart": found.accuracy,
        "told_apart_floor": found.floor_accuracy,
        "frechet": found.frechet,
        "frechet_floor": found.floor_frechet,
    }


def _split_by_kind(clips: Sequence[Motion], settings: GenerationBenchmarkSettings) -> dict[str, list[Motion]]:
    runs = [measure(clip)["speed_m_s"] > settings.running for clip in clips]
    return {
        kind: [clip for clip, ran in zip(clips, runs, strict=True) if ran == (kind == "run")]
        for kind in ("walk", "run")
    }


def _mean_measures(clips: Sequence[Motion]) -> Row:
    return average_rows([measure(clip) for clip in clips], _MEASURES) if clips else {}
