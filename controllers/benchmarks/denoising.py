"""What denoising is worth: clips that no training saw, spoilt in known ways, beside filters tuned on the truth."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.signal import butter, savgol_filter, sosfiltfilt
from torch import Tensor

from controllers.benchmarks.shared.corruptions import CONDITIONS, CorruptedClip, detect_true_contacts
from controllers.benchmarks.shared.held_out import CleanClip
from controllers.benchmarks.shared.tables import Row, average_rows
from controllers.denoising.denoise import denoise
from controllers.denoising.result import DenoiseSolution
from controllers.inbetweening.infill import infill
from mapctl import metrics, rotations
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.protocols import Denoiser, Density, Inbetweener
from mapctl.recording.inspection import Inspection, inspect_recording

STANDARD_CONDITION = "5 degrees, 2 cm, 1 % spikes"
"""The condition of the table by kind."""
_CUTOFFS = (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12)  # Hz
_SPANS = (0.1, 0.17, 0.23, 0.3, 0.4, 0.5, 0.7, 1.0)  # seconds of a Savitzky-Golay window


def benchmark_denoising(
    clips: Sequence[CleanClip],
    denoiser: Denoiser,
    *,
    infiller: Inbetweener | None = None,
    densities: Sequence[Density] = (),
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """By condition over all clips, then by kind of clip in the standard condition, then clean clips."""
    rows, done, conditions = [], 0, list(CONDITIONS)
    by_kind: dict[str, list[Row]] = {}
    for name in conditions:
        found = []
        for number, clip in enumerate(clips):
            spoilt = CONDITIONS[name](clip.motion, torch.Generator().manual_seed(number))
            found.append(evaluate_clip(clip.motion, spoilt, denoiser, densities, infiller))
            if name == STANDARD_CONDITION:
                by_kind.setdefault(clip.kind, []).append(found[-1])
            done += 1
            if progress is not None:
                progress(done, len(clips) * (len(conditions) + 1))
        rows.append({"what": name, "clips": len(clips), **average_rows(found)})
    rows += [
        {"what": f"{kind}, {STANDARD_CONDITION}", "clips": len(found), **average_rows(found)}
        for kind, found in by_kind.items()
    ]
    clean = []
    for clip in clips:
        clean.append(
            {"out_cm": _mean_joint_error_cm(clip.motion, denoise(clip.motion, denoiser, densities=densities).motion)}
        )
        done += 1
        if progress is not None:
            progress(done, len(clips) * (len(conditions) + 1))
    return [*rows, {"what": "clean, change", "clips": len(clips), **average_rows(clean)}]


def evaluate_clip(
    truth: Motion,
    spoilt: CorruptedClip,
    denoiser: Denoiser,
    densities: Sequence[Density] = (),
    infiller: Inbetweener | None = None,
) -> Row:
    """Mean joint error in and out and of the best filters (cm), contact F1, skate (cm/s) and jitter beside mocap's,
    milliseconds a frame; where joints are masked and there is an infiller, its error too.
    """
    filled = float("nan")
    if infiller is not None and spoilt.masks:
        filled = _mean_joint_error_cm(truth, infill(spoilt.motion, infiller, spoilt.masks).motion)
    began = time.perf_counter()
    done = denoise(spoilt.motion, denoiser, masks=spoilt.masks, densities=densities)
    seconds = time.perf_counter() - began
    butterworth, savgol = tune_filters(truth, inspect_recording(spoilt.motion, spoilt.masks))
    ours, mocap = metrics.measure(done.motion), metrics.measure(truth)
    out = _mean_joint_error_cm(truth, done.motion)
    return {
        "in_cm": _mean_joint_error_cm(truth, spoilt.motion),
        "out_cm": out,
        "butterworth_cm": butterworth,
        "savgol_cm": savgol,
        "infiller_cm": filled,
        "ratio": out / min(butterworth, savgol),
        "contact_f1": contact_f1(truth, done),
        "skate_cm_s": ours["skate_cm_s"],
        "mocap_skate": mocap["skate_cm_s"],
        "jitter_ratio": ours["jitter_m_s3"] / mocap["jitter_m_s3"],
        "believed": float(done.proposal_share.mean()),
        "ms_30fps_frame": 1000 * seconds / (truth.seconds * PRIOR_FPS),
    }


def tune_filters(truth: Motion, examined: Inspection) -> tuple[float, float]:
    """Lowest joint error (cm) of a Butterworth and of a Savitzky-Golay filter over the root's place and the joints'
    quaternions, tuned on the truth; what is masked is filled in first, spikes are not told to them.
    """
    known = replace(
        examined, spikes=torch.zeros_like(examined.spikes), spikes_root=torch.zeros_like(examined.spikes_root)
    )
    motion, fps = known.repaired(), float(truth.fps)
    butterworth, savgol = [], []
    for cutoff in _CUTOFFS:
        if cutoff < fps / 2:
            sections = butter(2, cutoff / (fps / 2), output="sos")  # forth and back: fourth order
            butterworth.append(
                _mean_joint_error_cm(truth, _apply_filter(motion, lambda v, s=sections: sosfiltfilt(s, v, axis=0)))
            )
    for span in _SPANS:
        width = 2 * round(span * fps / 2) + 1
        if 5 <= width <= motion.num_frames:
            savgol.append(
                _mean_joint_error_cm(truth, _apply_filter(motion, lambda v, w=width: savgol_filter(v, w, 3, axis=0)))
            )
    return min(butterworth), min(savgol)


def contact_f1(truth: Motion, done: DenoiseSolution) -> float:
    """Of planted toes in frames, against the thresholds' own answer on the clean clip; NaN where none is planted."""
    wanted, found = detect_true_contacts(truth), done.contacts
    at = (torch.arange(len(found)) * float(truth.fps) / PRIOR_FPS).round().long().clamp(max=len(wanted) - 1)
    wanted = wanted[at]
    both = float((wanted & found).sum())
    total = float(wanted.sum() + found.sum())
    return 2 * both / total if wanted.any() else float("nan")


def _apply_filter(motion: Motion, smooth: Callable[[np.ndarray], Any]) -> Motion:
    def over(values: Tensor) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(np.asarray(smooth(values.numpy()))))

    quats = over(rotations.make_sign_continuous(motion.local_quat_xyzw))
    moving = {joint: over(values) for joint, values in motion.moving_offsets.items()}
    return replace(
        motion,
        root_position=over(motion.root_position),
        moving_offsets=moving,
        local_quat_xyzw=torch.nn.functional.normalize(quats, dim=-1),
    )


def _mean_joint_error_cm(truth: Motion, other: Motion) -> float:
    """Mean distance of the joints, cm."""
    return 100 * float((truth.joint_positions() - other.joint_positions()).norm(dim=-1).mean())
