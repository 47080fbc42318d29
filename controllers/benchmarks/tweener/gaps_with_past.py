"""Benchmark of gaps as a recurrent network is given them (Zhou et al. 2020, table 4 and figure 9): 20 frames before a
gap and two behind it, of walks with one second and of all kinds with four seconds between.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch

from controllers.benchmarks.shared.bones import scale_to_canonical_bones
from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import GapSums, Method, measure_gap, query_gaps
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.proposers import SlerpInbetweener
from mapctl.motion import Motion

PAST_FRAMES, FRAMES_AFTER = 20, 2
"""Frames that are known before a gap and behind it (paper: 40 at 60 fps, and 2)."""


@dataclass(frozen=True)
class Setting:
    """Gaps of one length in clips of some kinds."""

    name: str
    """Name in the table."""
    frames: int
    """Frames of the gap, at PRIOR_FPS."""
    kinds: tuple[str, ...] = ()
    """Kinds of clips; all if none is named."""


SETTINGS = (Setting("Walk-1s", 30, ("walks",)), Setting("All-4s", 120))
"""Settings of table 4."""


def benchmark_gaps_with_past(
    kinds: Mapping[str, Sequence[Motion]],
    methods: Sequence[Method],
    *,
    settings: Sequence[Setting] = SETTINGS,
    count: int = 100,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure methods, and slerp, in at most `count` gaps of clips (canonical) by kind: what keys behind the gap are
    missed by before they are made exact, cm, of joints seen from the hips and of the hips from where the gap begins;
    and of the finished motion the error in the gap's last frame and in all of it, cm, the hips' over the ground, speed,
    spread, jerk and planted frames over mocap's as ratios of sums, and the planted toes' speed, cm/s.
    """
    compared = (Method("slerp", SlerpInbetweener(), InfillSettings(finish=False)), *methods)
    rows = []
    for number, setting in enumerate(settings):
        clips = [clip for kind, found in kinds.items() if kind in (setting.kinds or kinds) for clip in found]
        parts = _spread([part for clip in clips for part in cut_gaps(scale_to_canonical_bones(clip), setting.frames)])
        for method in compared if parts else ():
            rows.append({"setting": setting.name, "by": method.name, **_measure(parts[:count], method)})
        if progress is not None:
            progress(number + 1, len(settings))
    return rows


def cut_gaps(clip: Motion, frames: int) -> list[Motion]:
    """Cut a clip into pieces that do not overlap, of so many frames and those that are known around them."""
    size = PAST_FRAMES + frames + FRAMES_AFTER
    return [clip.slice(first, first + size) for first in range(0, clip.num_frames - size + 1, size)]


def _spread(parts: Sequence[Motion]) -> list[Motion]:
    """Order pieces so that the first ones are of clips far apart in the list."""
    order = torch.randperm(len(parts), generator=torch.Generator().manual_seed(0))
    return [parts[number] for number in order.tolist()]


def _measure(parts: Sequence[Motion], method: Method) -> Row:
    known = torch.ones(parts[0].num_frames, dtype=torch.bool)
    known[PAST_FRAMES:-FRAMES_AFTER] = False
    missed = (
        torch.stack([_miss_keys(part, method) for part in parts]).mean(dim=0).tolist() if method.raw else (None,) * 2
    )
    found = sum((measure_gap(part, method, known) for part in parts), GapSums())
    return {
        "gaps": found.clips,
        "key_joints_cm": missed[0],
        "key_hips_cm": missed[1],
        "last_cm": found.last / found.clips,
        **found.summarise(),
    }


def _miss_keys(part: Motion, method: Method) -> torch.Tensor:
    """Measure the frames behind the gap as the network makes them: joints seen from the hips, and the hips, which are
    in their place in the last frame before it, cm."""
    assert method.raw is not None
    known = torch.ones(part.num_frames, dtype=torch.bool)
    known[PAST_FRAMES:-FRAMES_AFTER] = False
    made, true = method.raw(query_gaps(part, known)), part.joint_positions()
    made = made + (true - made)[PAST_FRAMES - 1, 0]
    off = (made - true)[-FRAMES_AFTER:]
    joints = (off[:, 1:] - off[:, :1]).norm(dim=-1).mean()
    return 100 * torch.stack([joints, off[:, 0].norm(dim=-1).mean()])
