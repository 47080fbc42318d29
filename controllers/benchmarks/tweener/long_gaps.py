"""Benchmark of long gaps: one between two whole poses of a clip, beside slerp and mocap, as ratios of sums by kind."""

from collections.abc import Callable, Mapping, Sequence

import torch

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import GapSums, Method, measure_gap
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl.motion import Motion

SHORTEST_SHARE = 0.6
"""Share of the gap that a clip must have at least; of a shorter clip than the gap all but the ends is one."""


def benchmark_long_gaps(
    kinds: Mapping[str, Sequence[Motion]],
    methods: Sequence[Method],
    *,
    frames: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure methods, and slerp, by kind of clip (canonical, at PRIOR_FPS), with a gap of so many frames between two
    whole poses: errors, cm, of joints seen from the hips and of the hips over the ground; speed, spread, jerk and
    planted frames over mocap's; the planted toes' speed, cm/s; and the jerk at the keys (`measure_key_jerk`)."""
    compared = (Method("slerp", SlerpInbetweener(), InfillSettings(finish=False)), *methods)
    rows = []
    for number, (kind, clips) in enumerate(kinds.items()):
        fit = [cut_middle(scale_to_canonical_bones(clip), frames) for clip in clips]
        parts = [part for part in fit if part is not None]
        for method in compared:
            found = sum((_measure(part, method) for part in parts), GapSums())
            if found.clips:
                rows.append({"kind": kind, "clips": found.clips, "by": method.name, **found.summarise()})
        if progress is not None:
            progress(number + 1, len(kinds))
    return rows


def cut_middle(clip: Motion, frames: int) -> Motion | None:
    """Cut the middle with one frame on either side of the gap, or all of a shorter clip; None for one that is much
    too short."""
    if clip.num_frames < SHORTEST_SHARE * frames + 2:
        return None
    first = max(0, (clip.num_frames - frames - 2) // 2)
    return clip.slice(first, min(clip.num_frames, first + frames + 2))


def _measure(clip: Motion, method: Method) -> GapSums:
    known = torch.zeros(clip.num_frames, dtype=torch.bool)
    known[[0, -1]] = True
    return measure_gap(clip, method, known)
