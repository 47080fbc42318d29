"""Benchmark of the frequencies of made motion (Zhou et al. 2020, section 4.4; figure 8 shows them as pictures)."""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.long_gaps import cut_middle
from controllers.inbetweening.tween import tween
from mapctl import rotations
from mapctl.intent.keyframes import Keys
from mapctl.metrics.liveliness import see_from_hips
from mapctl.metrics.spectrum import BANDS_HZ, measure_speed_by_band
from mapctl.motion import Motion


def benchmark_spectrum(
    kinds: Mapping[str, Sequence[Motion]],
    methods: Sequence[Method],
    *,
    frames: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure the speed of joints seen from the hips, cm/s, by band (`measure_speed_by_band`), root mean square over
    the clips of a kind: of mocap, and of what each method makes between two of its poses so many frames apart. Clips
    are canonical, at PRIOR_FPS; shorter ones are measured as in `benchmark_long_gaps`."""
    rows: list[Row] = []
    for number, (kind, clips) in enumerate(kinds.items()):
        fit = [cut_middle(scale_to_canonical_bones(clip), frames) for clip in clips]
        parts = [part for part in fit if part is not None]
        if parts:
            rows.append(_summarise(kind, "mocap", parts))
        for method in methods if parts else ():
            made = [
                tween(part, Keys((0, part.num_frames - 1)), method.inbetweener, settings=method.settings).motion
                for part in parts
            ]
            rows.append(_summarise(kind, method.name, made))
        if progress is not None:
            progress(number + 1, len(kinds))
    return rows


def _summarise(kind: str, by: str, motions: Sequence[Motion]) -> Row:
    squares = torch.stack([_measure(motion) ** 2 for motion in motions])
    speeds = squares.mean(dim=0).sqrt().tolist()
    named = {f"{low:g}-{high:g}_hz": speed for (low, high), speed in zip(BANDS_HZ, speeds, strict=True)}
    return {"kind": kind, "clips": len(motions), "by": by, **named}


def _measure(motion: Motion) -> Float[Tensor, " bands"]:
    hips = rotations.to_matrix(motion.local_quat_xyzw[:, 0])
    return measure_speed_by_band(see_from_hips(motion.joint_positions(), hips), float(motion.fps))
