"""How a refiner in training is judged: its samples beside the raw ones and mocap that training does not see."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import GroundPose
from mapctl.metrics import measure
from mapctl.metrics.realism import RealismSettings, canonical_positions, cut_windows
from mapctl.metrics.realism.classifier import compute_held_out_accuracy
from mapctl.pose import decode
from priors import checkpoints
from priors.lstm_gmm.density import LstmGmmDensity
from priors.refiner.network import LstmRefiner, RefinerNetwork
from priors.training.corpus import Corpus

_WARM_UP_FRAMES = 60  # frames of a clip that condition the density before it runs freely


@dataclass(frozen=True, eq=False)
class RefinerEvaluator:
    """Measures refined samples beside the raw ones and mocap that training does not see."""

    raw: Float[Tensor, "count frames size"]
    """Samples that are refined anew each time."""
    mocap: dict[str, float]
    """Mocap's measures."""
    windows: list[Tensor]
    """Mocap's windows for the classifier."""
    settings: RealismSettings
    """Settings of the realism classifier."""

    @staticmethod
    def of(raw: Corpus, held: Corpus, settings: RealismSettings) -> "RefinerEvaluator":
        """Against clips that training does not see: of those that a refiner is chosen by, or of those that are left to
        measure the chosen one."""
        clips = [clip for clip in held.clips() if len(clip) > settings.windows.frames]
        motions = [decode(clip, GroundPose.origin()) for clip in clips]
        windows = [cut_windows(canonical_positions(motion), settings.windows) for motion in motions]
        return RefinerEvaluator(torch.stack(raw.clips()), _average_measures(clips), windows, settings)

    def __call__(self, network: RefinerNetwork) -> dict[str, float]:
        """Contact speed and jitter as ratios to mocap's, and the classifier's accuracy."""
        refiner = LstmRefiner("in training", network.eval(), _NO_CARD)
        refined = refiner.refine(self.raw)
        means = _average_measures(list(refined))
        row = {
            f"{name}_ratio": means[name] / self.mocap[name]
            for name in ("contact_speed_cm_s", "jitter_m_s3")
            if self.mocap[name] > 0
        }
        if min(len(refined), len(self.windows)) >= self.settings.min_clips:
            made = [
                cut_windows(canonical_positions(decode(clip, GroundPose.origin())), self.settings.windows)
                for clip in refined
            ]
            seeded = torch.Generator().manual_seed(0)
            row["told_apart"] = compute_held_out_accuracy(
                made, self.windows, generator=seeded, settings=self.settings.classifier
            )
        return row


def sample_corpus(prior: LstmGmmDensity, corpus: Corpus, count: int, frames: int, generator: torch.Generator) -> Corpus:
    """Free runs of the density, each after two seconds of a clip; clips are drawn by their length.

    So the samples have the data's own shares of gaits and speeds, and the critic is left with their quality.
    """
    clips = [clip for clip in corpus.clips() if len(clip) >= _WARM_UP_FRAMES]
    lengths = torch.tensor([float(len(clip)) for clip in clips])
    picked = torch.multinomial(lengths, count, replacement=True, generator=generator).tolist()
    state = prior.start_after(torch.stack([clips[i][0] for i in picked]))
    state = prior.advance(state, torch.stack([clips[i][1:_WARM_UP_FRAMES] for i in picked]))
    features, _ = prior.sample(state, frames, generator)
    return Corpus(tuple(f"sample {k}" for k in range(count)), (frames,) * count, features.float().flatten(0, 1))


def compute_realism_gap(row: Mapping[str, float | None]) -> float:
    """Less is better: how far foot speed and jitter are from mocap's (log ratios), and the classifier's accuracy.

    Infinite where a measure cannot be had, as of feet that never touch the floor.
    """
    ratios = [value or math.nan for name, value in row.items() if name.endswith("_ratio")]
    if not all(value > 0 for value in ratios):
        return math.inf
    told = row.get("told_apart") or 0.0
    return sum(abs(math.log(value)) for value in ratios) + 2 * max(0.0, told - 0.5)


_NO_CARD = checkpoints.Card("refiner", {}, licence="", **checkpoints.Card.layout_fields())


def _average_measures(clips: list[Tensor]) -> dict[str, float]:
    rows = [measure(decode(clip, GroundPose.origin())) for clip in clips]
    return {name: float(torch.tensor([row[name] for row in rows]).nanmean()) for name in rows[0]}
