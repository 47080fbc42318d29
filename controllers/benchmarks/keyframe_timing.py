"""Benchmark of suggested timing: the time between pairs of poses of clips, beside the model's, one speed's for all and
one duration for all.
"""

from collections.abc import Sequence

import torch

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from mapctl.inbetweening.pose_pairs import TRAVELLING_DISTANCE, TimingModel, sample_pose_pairs
from mapctl.motion import Motion

_PAIRS_PER_CLIP, _SHORTEST, _LONGEST = 5, 0.5, 3.0  # seconds, but the first
_MIN_TIMING_SECONDS = 0.2  # shortest time by one speed for all


def benchmark_keyframe_timing(clips: Sequence[Motion], timing: TimingModel) -> list[Row]:
    """Measure the ratio of the suggested to the true time of pairs 0.5 to 3 s apart: median and quartiles, and the
    factor within which half of them lie. The speed and the duration for all are the medians of the same pairs.
    """
    pairs = sample_pose_pairs(
        map(scale_to_canonical_bones, clips),
        torch.Generator().manual_seed(0),
        count=_PAIRS_PER_CLIP,
        shortest=_SHORTEST,
        longest=_LONGEST,
    )
    travelling = pairs.metres >= TRAVELLING_DISTANCE
    speed = (pairs.metres / pairs.seconds)[travelling].median() if bool(travelling.any()) else torch.tensor(1.0)
    methods = {
        "suggested": timing.estimate_seconds(pairs.features, pairs.metres)[:, 1],
        "one speed for all": (pairs.metres / speed).clamp_min(_MIN_TIMING_SECONDS),
        "one duration for all": pairs.seconds.median().expand_as(pairs.seconds),
    }
    rows = []
    for name, which in (("on the way", travelling), ("in place", ~travelling), ("all", torch.ones_like(travelling))):
        for method, seconds in methods.items():
            if bool(which.any()):
                ratio = (seconds / pairs.seconds)[which]
                low, middle, high = torch.quantile(ratio, ratio.new_tensor([0.25, 0.5, 0.75])).tolist()
                factor = float(ratio.log().abs().median().exp())
                row = {"pairs": name, "count": len(ratio), "method": method, "median": middle}
                rows.append({**row, "lower_quartile": low, "upper_quartile": high, "half_off_by": factor})
    return rows
