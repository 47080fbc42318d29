"""Benchmark of what gives generated motion away: joints, bands, moments and gaits beside unseen mocap."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import torch

from controllers.benchmarks.generation import Variant, generate_clips
from controllers.benchmarks.generation.continuations import continue_clips, cut_continuation, select_long_clips
from controllers.benchmarks.shared.bones import put_on_generated_bones
from controllers.benchmarks.shared.held_out import NamedClip
from controllers.benchmarks.shared.tables import Row
from mapctl.errors import RequestError
from mapctl.metrics.realism import (
    REGIONS,
    EvidenceSettings,
    Explanation,
    RealismSettings,
    canonical_positions,
    cut_windows,
    measure_alone,
    train_judges,
)
from mapctl.motion import Motion

SHARES = ("joints", "bands", "cells", "inputs", "phases", "feet")
"""Parts of the benchmark that hold shares of the evidence, as `Explanation` names them."""
_MOST = 8  # rows of a part for each variant


@dataclass(frozen=True)
class WhyBenchmarkSettings:
    """Size of the benchmark."""

    continued: bool = True
    """Whether each unseen clip is gone on with after its beginning, for as long as it lasts itself; else clips begin at
    the density's own initial states."""
    count: int = 48
    """Number of clips of each variant from initial states."""
    seconds: float = 10.0
    """Length of each clip from initial states, seconds."""
    steps: tuple[int, ...] = (400, 2000)
    """Training steps of the classifiers, one comparison for each."""
    seed: int = 0
    """Seed of initial states, samples and classifiers, the same for every variant."""
    realism: RealismSettings = field(default_factory=RealismSettings)
    """Settings of the classifiers but for their steps."""
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    """Settings of how evidence is gathered."""

    def __post_init__(self):
        if min(self.steps, default=0) < 1 or not 0 < self.seconds < float("inf"):
            raise RequestError("the table needs a length above 0 s and steps of at least 1")
        if not self.continued and self.count < self.realism.min_clips:
            raise RequestError(f"the table needs at least {self.realism.min_clips} clips, got {self.count}")


def benchmark_why(
    variants: Sequence[Variant], mocap: Sequence[NamedClip], settings: WhyBenchmarkSettings | None = None
) -> dict[str, list[Row]]:
    """Explain how each variant's clips are told from mocap, by part: how often, how often by a region of the body alone
    (after the steps of `settings.realism`), by gait, and the shares of the evidence that are more than chance.

    `mocap` is motion held out from training. RequestError for fewer than 8 clips of it.
    """
    settings = settings or WhyBenchmarkSettings()
    clips = select_long_clips(mocap) if settings.continued else list(mocap)
    ends = [cut_continuation(clip) if settings.continued else clip.motion for clip in clips]
    real = [canonical_positions(put_on_generated_bones(motion)) for motion in ends]
    parts: dict[str, list[Row]] = {"accuracy": [], "regions": [], "gaits": [], **{name: [] for name in SHARES}}
    for variant in variants:
        made = [canonical_positions(clip) for clip in _make_clips(variant, clips, settings)]
        alone = measure_alone(
            made,
            real,
            windows=settings.realism.windows,
            classifier=settings.realism.classifier,
            seed=settings.seed,
            groups=REGIONS,
            paired=settings.continued,
        )
        about = {"variant": variant.name, "steps": settings.realism.classifier.steps}
        parts["regions"] += [{**about, "region": name, "told_apart": accuracy} for name, accuracy in alone.items()]
        for steps in settings.steps:
            classifier = replace(settings.realism.classifier, steps=steps)
            judges = train_judges(
                [cut_windows(clip, settings.realism.windows) for clip in made],
                [cut_windows(clip, settings.realism.windows) for clip in real],
                generator=torch.Generator().manual_seed(settings.seed),
                settings=replace(settings.realism, classifier=classifier),
                paired=settings.continued,
            )
            generator = torch.Generator().manual_seed(settings.seed)
            found = judges.explain(made, real, generator=generator, settings=settings.evidence)
            _add_rows(parts, {"variant": variant.name, "steps": steps}, found)
    return parts


def _make_clips(variant: Variant, clips: Sequence[NamedClip], settings: WhyBenchmarkSettings) -> list[Motion]:
    if settings.continued:
        return continue_clips(variant, clips, settings.seed)
    return generate_clips(variant, settings.count, settings.seconds, settings.seed)


def _add_rows(parts: dict[str, list[Row]], about: Row, found: Explanation) -> None:
    parts["accuracy"].append(
        {
            **about,
            "told_apart": found.accuracy,
            "low": found.accuracy_low,
            "high": found.accuracy_high,
            "floor": found.floor,
            "above_floor": found.told_apart,
        }
    )
    for gait in found.gaits:
        row = asdict(gait)
        parts["gaits"].append({**about, **(row if found.told_apart else row | {"joint": None, "band": None})})
    if not found.told_apart:
        return
    for name in SHARES:
        named = [share for share in getattr(found, name) if share.named][:_MOST]
        parts[name] += [
            {**about, **{key: value for key, value in asdict(share).items() if value is not None}} for share in named
        ]
