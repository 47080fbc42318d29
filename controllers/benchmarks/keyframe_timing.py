"""What a suggested timing is worth: pairs of poses of clips, how far apart in time they were, and what is said of them
by the regression, by one speed for all and by one duration for all. And the fit of that regression.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.infilling import scale_to_canonical_bones
from controllers.inbetweening.keyframe_timing import (
    TRAVELLING_DISTANCE,
    compute_pair_features,
    compute_travel_distance,
    predict_seconds,
)
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion

Row = dict[str, Any]

_PAIRS_PER_CLIP = 5  # of every clip
_RIDGE, _MIN_DEVIATION, _REWEIGHTINGS = 1.0, 0.15, 15
_MIN_TIMING_SECONDS = 0.2  # seconds that one speed for all says at least


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Pairs of poses of mocap."""

    features: Float[Tensor, "pairs features"]
    """Of `controllers.inbetweening.keyframe_timing.FEATURES`."""
    metres: Float[Tensor, " pairs"]
    """Between the hips over the ground."""
    seconds: Float[Tensor, " pairs"]
    """Between the poses."""


def sample_pose_pairs(
    clips: Sequence[Motion], generator: torch.Generator, *, shortest: float = 0.5, longest: float = 3.0
) -> PosePairs:
    """Drawn from canonical clips, their seconds evenly between the bounds and the clip's own length."""
    features, metres, seconds = [], [], []
    low = round(shortest * PRIOR_FPS)
    for clip in clips:
        body = scale_to_canonical_bones(clip)
        high = min(round(longest * PRIOR_FPS), body.num_frames - 1)
        if high <= low:
            continue
        frames = torch.randint(low, high + 1, (_PAIRS_PER_CLIP,), generator=generator)
        first = (torch.rand(_PAIRS_PER_CLIP, generator=generator) * (body.num_frames - frames)).long()
        features.append(compute_pair_features(body, first, first + frames))
        metres.append(compute_travel_distance(body, first, first + frames))
        seconds.append(frames.double() / PRIOR_FPS)
    return PosePairs(torch.cat(features), torch.cat(metres), torch.cat(seconds))


def fit_timing_weights(pairs: PosePairs) -> Float[Tensor, " features"]:
    """Weights of the regression: least absolute deviations of the logarithm, by weighted least squares, with a ridge
    over features of about unit spread.
    """
    mean, spread = pairs.features.mean(dim=0), pairs.features.std(dim=0) + 1e-9
    mean[0], spread[0] = 0.0, 1.0
    unit, told = (pairs.features - mean) / spread, pairs.seconds.log()
    weights, counts = torch.zeros(unit.shape[1], dtype=unit.dtype), torch.ones_like(told)
    ridge = _RIDGE * torch.eye(unit.shape[1], dtype=unit.dtype)
    for _ in range(_REWEIGHTINGS):
        heavy = unit * counts[:, None]
        weights = torch.linalg.solve(heavy.T @ unit + ridge, heavy.T @ told)
        counts = 1 / (told - unit @ weights).abs().clamp_min(_MIN_DEVIATION)
    weights = weights / spread
    weights[0] -= (weights[1:] * mean[1:]).sum()
    return weights


def benchmark_keyframe_timing(clips: Sequence[Motion]) -> list[Row]:
    """Ratio of the suggested and the true time of pairs 0.5 to 3 s apart: median and quartiles, and the factor by which
    half of them are off at most. The speed and the duration for all are the medians of the same pairs.
    """
    pairs = sample_pose_pairs(clips, torch.Generator().manual_seed(0))
    going = pairs.metres >= TRAVELLING_DISTANCE
    speed = (pairs.metres / pairs.seconds)[going].median() if bool(going.any()) else torch.tensor(1.0)
    methods = {
        "suggested": predict_seconds(pairs.features, pairs.metres),
        "one speed for all": (pairs.metres / speed).clamp_min(_MIN_TIMING_SECONDS),
        "one duration for all": pairs.seconds.median().expand_as(pairs.seconds),
    }
    rows = []
    for name, which in (("on the way", going), ("in place", ~going), ("all", torch.ones_like(going))):
        for method, seconds in methods.items():
            if bool(which.any()):
                ratio = (seconds / pairs.seconds)[which]
                low, middle, high = torch.quantile(ratio, ratio.new_tensor([0.25, 0.5, 0.75])).tolist()
                off = float(ratio.log().abs().median().exp())
                rows.append(
                    {
                        "pairs": name,
                        "count": len(ratio),
                        "method": method,
                        "median": middle,
                        "lower_quartile": low,
                        "upper_quartile": high,
                        "half_off_by": off,
                    }
                )
    return rows
