"""What a suggested timing is worth: pairs of poses of clips, how far apart in time they were, and what is said of them
by the model, by one speed for all and by one duration for all.
"""

from collections.abc import Sequence
from typing import Any

import torch

from controllers.benchmarks.infilling import scale_to_canonical_bones
from mapctl.inbetweening.pose_pairs import TRAVELLING_DISTANCE, TimingModel, sample_pose_pairs
from mapctl.motion import Motion

Row = dict[str, Any]

_PAIRS_PER_CLIP, _SHORTEST, _LONGEST = 5, 0.5, 3.0  # seconds, but the first
_MIN_TIMING_SECONDS = 0.2  # seconds that one speed for all says at least


def benchmark_keyframe_timing(clips: Sequence[Motion], timing: TimingModel) -> list[Row]:
    """Ratio of the suggested and the true time of pairs 0.5 to 3 s apart: median and quartiles, and the factor by which
    half of them are off at most. The speed and the duration for all are the medians of the same pairs.
    """
    pairs = sample_pose_pairs(
        map(scale_to_canonical_bones, clips),
        torch.Generator().manual_seed(0),
        count=_PAIRS_PER_CLIP,
        shortest=_SHORTEST,
        longest=_LONGEST,
    )
    going = pairs.metres >= TRAVELLING_DISTANCE
    speed = (pairs.metres / pairs.seconds)[going].median() if bool(going.any()) else torch.tensor(1.0)
    methods = {
        "suggested": timing.estimate_seconds(pairs.features, pairs.metres)[:, 1],
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
