"""Benchmark of in-betweening: held-out clips of which a few keyframes are left; and extrapolation of their ends."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from controllers.benchmarks.shared.tables import Row, average_rows
from controllers.inbetweening.infill import infill
from controllers.inbetweening.proposers import AutoInbetweener, RolloutInbetweener
from controllers.inbetweening.proposers.rolling import select_likeliest_density
from controllers.inbetweening.solution import InbetweenSolution
from controllers.inbetweening.tween import tween
from controllers.inbetweening.variations import lowest_energy
from mapctl import metrics
from mapctl.features import PRIOR_FPS
from mapctl.intent.keyframes import Keys
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.masks import ALL, Mask
from mapctl.retarget import to_canonical
from mapctl.skeleton import TOES

TWEEN_FRAMES = 6 * PRIOR_FPS
"""Frames of a clip that are used."""
_INNER_KEYS = 5  # keyframes besides the first and the last
_END_SOURCE_FRAMES = 4 * PRIOR_FPS  # frames of a clip whose end is removed
_END_LENGTHS = (30, 60)  # frames
_NUM_ALTERNATIVES = 4  # answers
_WORST_FRAMES = ("step_cm", "acceleration_m_s2", "unsupported_s")
_WORST = ("key_mm", "jerk_at_keys", *_WORST_FRAMES, *(f"mocap_{name}" for name in _WORST_FRAMES))
"""Columns of which the largest of all clips stays: a mean would hide what is seen first."""


def benchmark_tweening(
    kinds: Mapping[str, Sequence[Motion]],
    inbetweener: Inbetweener,
    densities: Sequence[Density],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure by kind of clip (canonical, at the prior's rate): over 6 s the default tween, a rollout and the best of
    four, as means and the worst frames of all clips, and over 4 s ends of 1 and 2 s by the network and by a density.
    """
    rows: list[Row] = []
    # Keys of their own, whatever methods draw: two models are asked for the same frames.
    keys_drawn = torch.Generator().manual_seed(0)
    for number, (kind, clips) in enumerate(kinds.items()):
        shown = [clip.slice(0, TWEEN_FRAMES) for clip in clips if clip.num_frames >= TWEEN_FRAMES]
        by_method: dict[str, list[Row]] = {"chosen": [], "rolled": [], f"best of {_NUM_ALTERNATIVES}": []}
        for clip in shown:
            inner = (1 + torch.randperm(TWEEN_FRAMES - 2, generator=keys_drawn)[:_INNER_KEYS]).tolist()
            keys = Keys((0, *inner, TWEEN_FRAMES - 1))
            answers = _tween_by_all_methods(clip, keys, inbetweener, densities, torch.Generator().manual_seed(0))
            for method, made in zip(by_method, answers, strict=True):
                by_method[method].append(_evaluate_tween(made.motion, clip, keys.frames, made.seconds))
        rows += [
            {"kind": kind, "what": "keys", "by": method, "clips": len(each), **average_rows(each, worst=_WORST)}
            for method, each in by_method.items()
            if each
        ]
        shown = [clip.slice(0, _END_SOURCE_FRAMES) for clip in clips if clip.num_frames >= _END_SOURCE_FRAMES]
        for count in _END_LENGTHS:
            for by, way in (("network", inbetweener), ("density", AutoInbetweener(inbetweener, densities))):
                each = [_evaluate_end(clip, count, way) for clip in shown]
                if each:
                    told_end = {"kind": kind, "what": f"end of {count} frames", "by": by, "clips": len(each)}
                    rows.append({**told_end, **average_rows(each)})
        if progress is not None:
            progress(number + 1, len(kinds))
    return rows


def _tween_by_all_methods(
    clip: Motion, keys: Keys, inbetweener: Inbetweener, densities: Sequence[Density], draws: torch.Generator
) -> Iterator[InbetweenSolution]:
    """Tween by the default method, by a rollout, and by the lowest energy of several answers."""

    def make(inbetweener: Inbetweener, generator: torch.Generator) -> InbetweenSolution:
        return tween(clip, keys, inbetweener, generator=generator)

    yield make(AutoInbetweener(inbetweener, densities), draws)
    density = select_likeliest_density(densities, to_canonical(clip)[0])
    yield make(RolloutInbetweener([density], inbetweener), draws)
    yield lowest_energy(make, RolloutInbetweener(densities, inbetweener), _NUM_ALTERNATIVES, generator=draws)


def _evaluate_tween(made: Motion, clip: Motion, keys: Sequence[int], seconds: float) -> Row:
    """Measure errors at keyframes and between them; jerk at keyframes as a share of the clip's own 95th percentile."""
    positions, truth = made.joint_positions(), clip.joint_positions()
    jerk, usual = (torch.diff(each, n=3, dim=0).norm(dim=-1).mean(dim=-1) for each in (positions, truth))
    at_keys = max(float(jerk[max(0, key - 3) : key + 1].max()) for key in keys)
    away = (positions - truth).norm(dim=-1)
    ends, toes = ([made.skeleton.index(name) for name in names] for names in (("leftHand", "rightHand", *TOES), TOES))
    worst_ours, worst_mocap = (_measure_worst_frames(each.joint_positions(), ends, toes) for each in (made, clip))
    return {
        "key_mm": 1000 * float(away[list(keys)].max()),
        "error_cm": 100 * float(away.mean()),
        "jerk_at_keys": at_keys / float(usual.quantile(0.95)),
        **_compare_feet(made, clip),
        **worst_ours,
        **{f"mocap_{name}": value for name, value in worst_mocap.items()},
        "ms_frame": 1000 * seconds / made.num_frames,
    }


def _measure_worst_frames(positions: Tensor, ends: Sequence[int], toes: Sequence[int]) -> Row:
    """Measure the largest step (cm in 1/30 s) and acceleration of hands and toes, and the longest unsupported time."""
    peaks = worst_frame.measure_peaks(positions[:, ends], positions[:, 0], PRIOR_FPS)
    return {
        "step_cm": 100 * peaks.step,
        "acceleration_m_s2": peaks.acceleration,
        "unsupported_s": worst_frame.measure_longest_unsupported(positions[:, toes], positions[:, 0], PRIOR_FPS),
    }


def _evaluate_end(clip: Motion, count: int, inbetweener: Inbetweener) -> Row:
    first = clip.num_frames - count
    done = infill(clip, inbetweener, [Mask(ALL, first, clip.num_frames)])
    made = done.motion
    away = (made.joint_positions() - clip.joint_positions())[first:].norm(dim=-1)
    ends = [each.slice(first, clip.num_frames) for each in (made, clip)]
    return {"error_cm": 100 * float(away.mean()), **_compare_feet(*ends), "ms_frame": 1000 * done.seconds / count}


def _compare_feet(made: Motion, clip: Motion) -> Row:
    ours, theirs = metrics.measure(made), metrics.measure(clip)
    return {
        "skate_cm_s": ours["skate_cm_s"],
        "mocap_skate": theirs["skate_cm_s"],
        "planted_cm_s": ours["contact_speed_cm_s"],
        "mocap_planted": theirs["contact_speed_cm_s"],
        "jitter": ours["jitter_m_s3"] / theirs["jitter_m_s3"],
    }
