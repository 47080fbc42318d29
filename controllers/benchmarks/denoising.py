"""Benchmark of denoising: held-out clips with known corruptions, beside filters tuned on the truth."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from scipy.signal import savgol_filter

from controllers.benchmarks.shared.corruptions import CONDITIONS, CorruptedClip, detect_true_contacts
from controllers.benchmarks.shared.filters import apply_filter, design_butterworth
from controllers.benchmarks.shared.held_out import CleanClip
from controllers.benchmarks.shared.tables import Row, average_rows
from controllers.denoising.denoise import denoise
from controllers.denoising.result import DenoiseSolution
from controllers.inbetweening.infill import infill
from mapctl import metrics
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.protocols import Denoiser, Density, Inbetweener
from mapctl.recording.inspection import Inspection, inspect_recording

STANDARD_CONDITION = "5 degrees, 2 cm, 1 % spikes"
"""Condition of the table by kind of clip."""
_CUTOFFS = (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12)  # Hz
_SPANS = (0.1, 0.17, 0.23, 0.3, 0.4, 0.5, 0.7, 1.0)  # seconds of a Savitzky-Golay window


def benchmark_denoising(
    clips: Sequence[CleanClip],
    denoiser: Denoiser,
    *,
    inbetweener: Inbetweener | None = None,
    densities: Sequence[Density] = (),
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure each condition over all clips, then each kind of clip in the standard condition, then clean clips."""
    rows, done, total = [], 0, len(clips) * (len(CONDITIONS) + 1)
    by_kind: dict[str, list[Row]] = {}
    for name, corrupt in CONDITIONS.items():
        found = []
        for number, clip in enumerate(clips):
            corrupted = corrupt(clip.motion, torch.Generator().manual_seed(number))
            found.append(evaluate_clip(clip.motion, corrupted, denoiser, densities, inbetweener))
            if name == STANDARD_CONDITION:
                by_kind.setdefault(clip.kind, []).append(found[-1])
            done += 1
            if progress is not None:
                progress(done, total)
        rows.append({"what": name, "clips": len(clips), **average_rows(found)})
    rows += [
        {"what": f"{kind}, {STANDARD_CONDITION}", "clips": len(found), **average_rows(found)}
        for kind, found in by_kind.items()
    ]
    clean = []
    for clip in clips:
        denoised = denoise(clip.motion, denoiser, densities=densities).motion
        clean.append({"out_cm": _mean_joint_error_cm(clip.motion, denoised)})
        done += 1
        if progress is not None:
            progress(done, total)
    return [*rows, {"what": "clean, change", "clips": len(clips), **average_rows(clean)}]


def evaluate_clip(
    truth: Motion,
    corrupted: CorruptedClip,
    denoiser: Denoiser,
    densities: Sequence[Density] = (),
    inbetweener: Inbetweener | None = None,
) -> Row:
    """Measure the mean joint error in and out and of the best filters (cm), contact F1, skate (cm/s) and jitter beside
    mocap's, milliseconds a frame; where joints are masked and there is an in-betweener, which then helps, also the
    errors of the denoiser alone and of infilling alone.
    """
    filled = alone = float("nan")
    if inbetweener is not None and corrupted.masks:
        without = denoise(corrupted.motion, denoiser, masks=corrupted.masks, densities=densities)
        alone = _mean_joint_error_cm(truth, without.motion)
        filled = _mean_joint_error_cm(truth, infill(corrupted.motion, inbetweener, corrupted.masks).motion)
    began = time.perf_counter()
    done = denoise(corrupted.motion, denoiser, inbetweener=inbetweener, masks=corrupted.masks, densities=densities)
    seconds = time.perf_counter() - began
    butterworth, savgol = tune_filters(truth, inspect_recording(corrupted.motion, corrupted.masks))
    ours, mocap = metrics.measure(done.motion), metrics.measure(truth)
    out = _mean_joint_error_cm(truth, done.motion)
    return {
        "in_cm": _mean_joint_error_cm(truth, corrupted.motion),
        "out_cm": out,
        "butterworth_cm": butterworth,
        "savgol_cm": savgol,
        "denoiser_alone_cm": alone,
        "infill_alone_cm": filled,
        "ratio": out / min(butterworth, savgol),
        "contact_f1": contact_f1(truth, done),
        "skate_cm_s": ours["skate_cm_s"],
        "mocap_skate": mocap["skate_cm_s"],
        "jitter_ratio": ours["jitter_m_s3"] / mocap["jitter_m_s3"],
        "believed": float(done.proposal_share.mean()),
        "ms_30fps_frame": 1000 * seconds / (truth.seconds * PRIOR_FPS),
    }


def tune_filters(truth: Motion, inspection: Inspection) -> tuple[float, float]:
    """Compute the lowest joint error (cm) of a Butterworth and of a Savitzky-Golay filter over the root position and
    the joints' quaternions, tuned on the truth; masked values are filled in first, spikes are not.
    """
    none, none_root = torch.zeros_like(inspection.spikes), torch.zeros_like(inspection.spikes_root)
    motion, fps = replace(inspection, spikes=none, spikes_root=none_root).repaired(), float(truth.fps)
    butterworth, savgol = [], []
    for cutoff in _CUTOFFS:
        if cutoff < fps / 2:
            filtered = apply_filter(motion, design_butterworth(cutoff, fps))
            butterworth.append(_mean_joint_error_cm(truth, filtered))
    for span in _SPANS:
        width = 2 * round(span * fps / 2) + 1
        if 5 <= width <= motion.num_frames:
            filtered = apply_filter(motion, lambda v, w=width: savgol_filter(v, w, 3, axis=0))
            savgol.append(_mean_joint_error_cm(truth, filtered))
    return min(butterworth), min(savgol)


def contact_f1(truth: Motion, done: DenoiseSolution) -> float:
    """Compute the F1 score of contacts by frame against those detected on the clean clip; NaN where it has none."""
    wanted, found = detect_true_contacts(truth), done.contacts
    at = (torch.arange(len(found)) * float(truth.fps) / PRIOR_FPS).round().long().clamp(max=len(wanted) - 1)
    wanted = wanted[at]
    both = float((wanted & found).sum())
    total = float(wanted.sum() + found.sum())
    return 2 * both / total if wanted.any() else float("nan")


def _mean_joint_error_cm(truth: Motion, other: Motion) -> float:
    """Compute the mean distance of the joints, cm."""
    return 100 * float((truth.joint_positions() - other.joint_positions()).norm(dim=-1).mean())
