"""Fit of the keyframe timing: least absolute deviations of the logarithm of seconds, over pairs of poses of mocap."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import GroundPose
from mapctl.inbetweening.pose_pairs import TRAVELLING_DISTANCE, PosePairs, sample_pose_pairs
from mapctl.pose import decode
from priors.keyframe_timing import LONGEST, SHORTEST, KeyframeTimingConfig, KeyframeTimingNetwork
from priors.training.data import Corpus, Split
from priors.training.loop import Count, Export, Row, Settings, Trainer, geometric_mean

_PAIRS = 5  # pairs of poses drawn of every clip
_PERCENTILES = (0.1, 0.9)  # between which four of five pairs lie
_RIDGE = 1.0  # weight of the squared weights, of features of about unit spread
_MIN_DEVIATION = 0.15  # of the logarithm of seconds, below which all deviations weigh the same


@dataclass(frozen=True, kw_only=True)
class KeyframeTimingSettings(Settings):
    """Fit how long people take from one pose to the next, which tween suggests; a step reweights the least squares."""

    kind = "keyframe-timing"
    used_by = "use it with mapctl tween --suggest-timing --timing"

    steps: Count = 15
    """Reweightings of the least squares."""

    def make_trainer(self, parts: Split) -> "KeyframeTimingTrainer":
        """Make the trainer with the pairs of poses that the timing is fitted to."""
        return KeyframeTimingTrainer(self, parts.train)


class KeyframeTimingTrainer(Trainer[KeyframeTimingNetwork]):
    """Solves for the weights again and again, with less and less weight on pairs that are far off."""

    def __init__(self, settings: KeyframeTimingSettings, corpus: Corpus):
        super().__init__(settings)
        self.config = KeyframeTimingConfig()
        self.network = KeyframeTimingNetwork(self.config).double()
        self.pairs = draw_pairs(corpus, self.generator)

    def train_step(self) -> dict[str, float]:
        """Solve once, and see within which bounds the truth lies; the factor by which half of the pairs are off."""
        network, pairs = self.network, self.pairs
        weights = solve_weights(pairs, network.weights if self.step else None)
        network.weights.copy_(weights)
        ratio = pairs.seconds / network(pairs.features, pairs.metres)[:, 1]
        for row, which in enumerate(_split_by_distance(pairs)):
            if bool(which.any()):
                network.ratios[row] = torch.quantile(ratio[which], ratio.new_tensor(_PERCENTILES))
        self.step += 1
        return {"half_off_by": _measure_error(ratio)}

    def validate(self, corpus: Corpus) -> Row:
        """The factor by which half of unseen pairs are off, and the share that lies within the bounds."""
        pairs = draw_pairs(corpus, torch.Generator().manual_seed(0))
        low, suggested, high = self.network(pairs.features, pairs.metres).unbind(dim=-1)
        ratio, inside = pairs.seconds / suggested, (pairs.seconds >= low) & (pairs.seconds <= high)
        row: Row = {"pairs": len(ratio), "half_off_by": _measure_error(ratio), "within": float(inside.double().mean())}
        for name, which in zip(("in_place", "on_the_way"), _split_by_distance(pairs), strict=True):
            if bool(which.any()):
                row[f"{name}_half_off_by"] = _measure_error(ratio[which])
        return row

    def score(self, row: Row) -> float:
        """Return the factor by which half of unseen pairs are off at most."""
        return geometric_mean([row.get("half_off_by")])

    def export(self, parts: Split) -> Export:
        """Export the weights in float32: they are less than a kilobyte."""
        done = super().export(parts)
        done.tensors = {name: value.float() for name, value in done.tensors.items()}
        done.data, done.half = {"pairs": len(self.pairs.seconds)}, False
        return done


def draw_pairs(corpus: Corpus, generator: torch.Generator) -> PosePairs:
    """Draw pose pairs from every clip of a corpus; RequestError where no clip is long enough."""
    origin = GroundPose.origin(torch.float64)
    bodies = (decode(clip.double(), origin) for clip in corpus.clips())
    return sample_pose_pairs(bodies, generator, count=_PAIRS, shortest=SHORTEST, longest=LONGEST)


def solve_weights(pairs: PosePairs, before: Float[Tensor, " features"] | None) -> Float[Tensor, " features"]:
    """Solve the regression: least squares of the logarithm of seconds with a ridge over features of about unit spread.

    Each pair is weighted by one over the absolute residual of the weights `before`, so that repeated calls minimise
    absolute instead of squared deviations.
    """
    mean, spread = pairs.features.mean(dim=0), pairs.features.std(dim=0) + 1e-9
    mean[0], spread[0] = 0.0, 1.0
    unit, wanted = (pairs.features - mean) / spread, pairs.seconds.log()
    counts = torch.ones_like(wanted)
    if before is not None:
        counts = 1 / (wanted - pairs.features @ before).abs().clamp_min(_MIN_DEVIATION)
    heavy = unit * counts[:, None]
    ridge = _RIDGE * torch.eye(unit.shape[1], dtype=unit.dtype)
    weights = torch.linalg.solve(heavy.T @ unit + ridge, heavy.T @ wanted) / spread
    weights[0] -= (weights[1:] * mean[1:]).sum()
    return weights


def _split_by_distance(pairs: PosePairs) -> tuple[Tensor, Tensor]:
    """Return two masks of the pairs: those that stay about in place, and those that travel."""
    going = pairs.metres >= TRAVELLING_DISTANCE
    return ~going, going


def _measure_error(ratio: Float[Tensor, " pairs"]) -> float:
    """The factor by which half of the pairs are off at most."""
    return float(ratio.log().abs().median().exp())
