"""Benchmark of transitions by LaFAN1's protocol (Harvey et al. 2020): gaps in unseen clips after ten frames, after one
bare pose, or with the whole clip around, by kind of clip, length and method.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.pipeline import InfillSettings, fill
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.retrieval import MotionCollection, bend_to_ends
from mapctl.metrics import body, feet, transitions, worst_frame
from mapctl.metrics.realism import (
    RealismSettings,
    WindowSettings,
    canonical_positions,
    cut_windows,
    measure_window_realism,
)
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES

LENGTHS = (5, 15, 30, 45)
"""Frames of the gaps, as in the tables of LaFAN1."""
WINDOW, STRIDE = 65, 40
"""Frames of a test window, and from one to the next."""
ALL_KINDS = "mean of kinds"
"""Kind of the rows that average those of all kinds."""
_PAST = 10  # frames before the gap
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))
_REALISM_LENGTH = 30
_REALISM = RealismSettings(windows=WindowSettings(frames=30))

Method = Callable[[Motion, int, int], Motion]
"""Fills frames start to stop of a canonical motion, whose values there are the truth and must not be looked at."""


@dataclass(frozen=True, eq=False)
class _Gap:
    """One gap of one clip."""

    part: Motion
    """Frames that a method is given."""
    start: int
    stop: int
    """Frames of the gap in it."""
    around: Motion
    """The gap with up to ten true frames on either side."""
    lead: int
    """Frames of `around` before the gap."""


def benchmark_transitions(
    kinds: Mapping[str, Sequence[Motion]],
    methods: Mapping[str, Method],
    *,
    past: int | None,
    std: Float[Tensor, "joints 3"],
    baseline: str,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure every method by kind of clip and length of gap; clips are canonical, of canonical bones, at PRIOR_FPS.

    `past` frames are known before a gap, and one after; None shows the whole clip. L2P divides by `std`. Shares are of
    the method `baseline`. Also: planted toes, jitter and the worst frames of gaps with ten true frames on either side,
    beside mocap's; how often a small network tells gaps of 30 frames from mocap; milliseconds for each filled frame.
    """
    rows, total = [], len(LENGTHS) * len(kinds) * len(methods)
    for length in LENGTHS:
        made: dict[str, list[Tensor]] = {name: [] for name in ("mocap", *methods)}
        found = []
        for kind, clips in kinds.items():
            gaps = [gap for clip in clips for gap in _find_gaps(clip, length, past)]
            if not gaps:
                continue
            truth = [gap.around for gap in gaps]
            made["mocap"] += [_cut(motion) for motion in truth] if length == _REALISM_LENGTH else []
            here = [{"method": "mocap", **_measure_motion(truth)}]
            for name, method in methods.items():
                began = time.process_time()
                filled = [_fill(method, gap) for gap in gaps]
                cost = 1000 * (time.process_time() - began) / (length * len(gaps))
                here.append(
                    {"method": name, **_compare(filled, gaps, std), **_measure_motion(filled), "frame_ms": cost}
                )
                made[name] += [_cut(motion) for motion in filled] if length == _REALISM_LENGTH else []
                if progress is not None:
                    progress(min(total, len(rows) + len(found) + len(here)), total)
            found += [{"kind": kind, "frames": length, "windows": len(gaps), **row} for row in here]
        rows += found + _average_kinds(found, ["mocap", *methods], baseline, length)
        if length == _REALISM_LENGTH:
            _add_realism(rows, made)
    return rows


def of_inbetweener(inbetweener: Inbetweener, densities: Sequence[Density] = (), *, finish: bool = True) -> Method:
    """Return the method of an in-betweener, raw or finished by MAP, as `mapctl infill` runs it."""

    def method(part: Motion, start: int, stop: int) -> Motion:
        free = torch.zeros(part.num_frames, dtype=torch.bool)
        free[start:stop] = True
        missing = MissingMask.of_frames(free, part.num_joints)
        return fill(part, missing, inbetweener, settings=InfillSettings(finish=finish), densities=densities).motion

    return method


def hold_last_pose(part: Motion, start: int, stop: int) -> Motion:
    """Hold the pose before the gap: zero velocity."""
    source = torch.arange(part.num_frames)
    source[start:stop] = start - 1
    return replace(part, root_position=part.root_position[source], local_quat_xyzw=part.local_quat_xyzw[source])


def of_retrieval(collection: MotionCollection) -> Method:
    """Return the method that takes the nearest window of other clips, its ends bent."""

    def method(part: Motion, start: int, stop: int) -> Motion:
        first, last = part.slice(start - 1, start), part.slice(stop, stop + 1)
        found = bend_to_ends(collection.find_nearest(first, last, stop - start + 1), first, last)
        root, quats = part.root_position.clone(), part.local_quat_xyzw.clone()
        root[start:stop], quats[start:stop] = found.root_position[1:-1], found.local_quat_xyzw[1:-1]
        return replace(part, root_position=root, local_quat_xyzw=quats)

    return method


def _find_gaps(clip: Motion, length: int, past: int | None) -> list[_Gap]:
    gaps = []
    for first in range(0, clip.num_frames - WINDOW, STRIDE):
        start, stop = first + _PAST, first + _PAST + length
        begin, end = (0, clip.num_frames) if past is None else (start - past, stop + 1)
        after = min(clip.num_frames, stop + 10)
        part = clip.slice(begin, end)
        gaps.append(_Gap(part, start - begin, stop - begin, clip.slice(start - 10, after), 10))
    return gaps


def _fill(method: Method, gap: _Gap) -> Motion:
    """Return the gap as filled, with its true frames around."""
    done = method(gap.part, gap.start, gap.stop)
    root, quats = gap.around.root_position.clone(), gap.around.local_quat_xyzw.clone()
    into = slice(gap.lead, gap.lead + gap.stop - gap.start)
    root[into], quats[into] = done.root_position[gap.start : gap.stop], done.local_quat_xyzw[gap.start : gap.stop]
    return replace(gap.around, root_position=root, local_quat_xyzw=quats)


def _compare(made: Sequence[Motion], gaps: Sequence[_Gap], std: Tensor) -> Row:
    """Measure errors of one length."""
    length = gaps[0].stop - gaps[0].start
    sides = []
    for motions in (made, [gap.around for gap in gaps]):
        parts = [motion.slice(10, 10 + length) for motion in motions]
        sides.append(
            (
                torch.stack([part.joint_positions() for part in parts]),
                torch.stack([part.joint_rotations() for part in parts]),
            )
        )
    (positions, quats), (true_positions, true_quats) = sides
    ade, last = transitions.compute_displacement_errors(positions, true_positions)
    return {
        "ade_cm": 100 * ade,
        "last_cm": 100 * last,
        "l2p": transitions.compute_l2p(positions, true_positions, std),
        "l2q": transitions.compute_l2q(quats, true_quats),
        "npss": transitions.compute_npss(quats, true_quats),
    }


def _measure_motion(motions: Sequence[Motion]) -> Row:
    """Measure what a viewer sees: means over gaps, and the worst frame of all."""
    planted, jitter, steps, accelerations = [], [], [], []
    for motion in motions:
        positions = motion.joint_positions()
        toes = feet.ToeMeasurements.of(positions[:, _TOES], PRIOR_FPS)
        planted.append(toes.speed[toes.planted[1:]])
        jitter.append(body.jitter(positions, PRIOR_FPS))
        peaks = worst_frame.measure_peaks(positions[:, _EFFECTORS], motion.root_position, PRIOR_FPS)
        steps.append(peaks.step)
        accelerations.append(peaks.acceleration)
    return {
        "planted_cm_s": 100 * float(torch.cat(planted).mean()),
        "jitter_m_s3": sum(jitter) / len(jitter),
        "step_cm": 100 * max(steps),
        "acceleration_m_s2": max(accelerations),
    }


def _average_kinds(found: Sequence[Row], methods: Sequence[str], baseline: str, length: int) -> list[Row]:
    """Average over kinds, and add shares of the baseline's errors to all rows."""
    errors = ("ade_cm", "l2p", "l2q", "npss")
    by_kind = {(row["kind"], row["method"]): row for row in found}
    rows = []
    for method in methods:
        own = [row for row in found if row["method"] == method]
        if not own:
            continue
        columns = [name for name in own[0] if name not in ("kind", "frames", "windows", "method")]
        mean: Row = {"kind": ALL_KINDS, "frames": length, "windows": sum(row["windows"] for row in own)}
        mean |= {"method": method}
        worst = ("step_cm", "acceleration_m_s2")
        for name in columns:
            values = [row[name] for row in own]
            mean[name] = max(values) if name in worst else sum(values) / len(values)
        rows.append(mean)
    by_kind |= {(row["kind"], row["method"]): row for row in rows}
    for row in by_kind.values():
        reference = by_kind.get((row["kind"], baseline))
        if reference is not None and "ade_cm" in row:
            row |= {f"{name.removesuffix('_cm')}_share": row[name] / max(reference[name], 1e-12) for name in errors}
    return rows


def _cut(motion: Motion) -> Tensor:
    """Cut a gap out, with the frame before it, for the network that tells it from mocap."""
    part = motion.slice(9, 10 + _REALISM_LENGTH)
    return cut_windows(canonical_positions(part), _REALISM.windows)


def _add_realism(rows: list[Row], made: Mapping[str, Sequence[Tensor]]) -> None:
    mocap = made["mocap"]
    if len(mocap) < _REALISM.min_clips:
        return
    for row in rows:
        if row["kind"] == ALL_KINDS and row["frames"] == _REALISM_LENGTH and row["method"] != "mocap":
            found = measure_window_realism(
                made[row["method"]], mocap, generator=torch.Generator().manual_seed(0), settings=_REALISM
            )
            row |= {"told_apart": found.accuracy, "mocap_told_apart": found.floor_accuracy, "frechet": found.frechet}
