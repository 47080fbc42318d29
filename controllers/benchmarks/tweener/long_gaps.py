"""Benchmark of long gaps: one between two whole poses of a clip, beside slerp and mocap, as ratios of sums by kind."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.infilling import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from controllers.inbetweening.tween import tween
from mapctl import rotations
from mapctl.intent.keyframes import Keys
from mapctl.metrics.feet import ToeMeasurements
from mapctl.metrics.liveliness import NOTHING, Liveliness, measure_liveliness, see_from_hips
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.skeleton import TOE_JOINTS

SHORTEST_SHARE = 0.6
"""Share of the gap that a clip must have at least; of a shorter clip than the gap all but the ends is one."""


@dataclass(frozen=True)
class Method:
    """A way to fill gaps."""

    name: str
    """Name in the table."""
    inbetweener: Inbetweener
    """Who proposes."""
    settings: InfillSettings = field(default_factory=InfillSettings)
    """Whether MAP finishes."""


@dataclass(frozen=True)
class _Sums:
    made: Liveliness = NOTHING
    true: Liveliness = NOTHING
    clips: int = 0
    frames: int = 0
    off_hips: float = 0.0  # cm
    planted: float = 0.0  # frames, of either toe
    true_planted: float = 0.0
    sliding: float = 0.0  # cm/s, summed over planted frames
    true_sliding: float = 0.0
    key_jerk: float = 0.0
    seconds: float = 0.0

    def __add__(self, other: "_Sums") -> "_Sums":
        return _Sums(**{name: value + getattr(other, name) for name, value in vars(self).items()})


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
            found = sum((_measure(part, method) for part in parts), _Sums())
            if found.clips:
                rows.append({"kind": kind, "clips": found.clips, "by": method.name, **_summarise(found)})
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


def _measure(clip: Motion, method: Method) -> _Sums:
    last = clip.num_frames - 1
    done = tween(clip, Keys((0, last)), method.inbetweener, settings=method.settings)
    inside = torch.ones(clip.num_frames, dtype=torch.bool)
    inside[[0, last]] = False
    true, made = _see(clip), _see(done.motion)
    off = (done.motion.root_position - clip.root_position)[inside][:, ::2].norm(dim=-1)
    ours, theirs = (
        ToeMeasurements.of(each.joint_positions()[:, list(TOE_JOINTS)], float(each.fps)) for each in (done.motion, clip)
    )
    return _Sums(
        measure_liveliness(made, true, inside),
        measure_liveliness(true, true, inside),
        1,
        clip.num_frames,
        100 * float(off.mean()),
        float(ours.planted[1:].sum()),
        float(theirs.planted[1:].sum()),
        100 * float(ours.speed[ours.planted[1:]].sum()),
        100 * float(theirs.speed[theirs.planted[1:]].sum()),
        measure_key_jerk(done.motion, clip),
        done.seconds,
    )


def measure_key_jerk(made: Motion, true: Motion) -> float:
    """Measure the largest jerk beside the first and the last frame, over the 95th percentile of mocap's: of means over
    joints in the world, in the two third differences at either end."""
    ours, theirs = (torch.diff(each.joint_positions(), n=3, dim=0).norm(dim=-1).mean(dim=-1) for each in (made, true))
    return float(ours[[0, 1, -2, -1]].max() / theirs.quantile(0.95).clamp_min(1e-9))


def _see(motion: Motion) -> Float[Tensor, "frames joints 3"]:
    return see_from_hips(motion.joint_positions(), rotations.to_matrix(motion.local_quat_xyzw[:, 0]))


def _summarise(found: _Sums) -> Row:
    made, true = found.made, found.true
    return {
        "error_cm": made.error / made.count,
        "hips_cm": found.off_hips / found.clips,
        "speed": made.speed / max(true.speed, 1e-9),
        "spread": made.spread / max(true.spread, 1e-9),
        "jerk": made.jerk / max(true.jerk, 1e-9),
        "planted": found.planted / max(found.true_planted, 1e-9),
        "planted_cm_s": found.sliding / max(found.planted, 1.0),
        "mocap_cm_s": found.true_sliding / max(found.true_planted, 1.0),
        "key_jerk": found.key_jerk / found.clips,
        "ms_frame": 1000 * found.seconds / found.frames,
    }
