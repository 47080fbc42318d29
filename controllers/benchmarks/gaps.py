"""How far answers for gaps are from the truth, by who gave them and how long the gap was: what notes on gaps tell."""

from collections.abc import Callable, Mapping, Sequence

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.error_estimates import is_travelling
from controllers.inbetweening.pipeline import fill
from controllers.inbetweening.proposers import AutoInbetweener
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.metrics import worst_frame
from mapctl.motion import Motion
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES

GAP_LENGTHS = (15, 30, 60, 90, 120, 180)
"""Frames of the gaps."""
_CONTEXT_LENGTHS = (1, 10)  # known frames on either side


def benchmark_gaps(
    kinds: Mapping[str, Sequence[Motion]],
    infiller: Inbetweener,
    densities: Sequence[Density],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Fill gaps of so many frames in the middle of clips (canonical, at PRIOR_FPS): quantiles over clips of the mean
    error of all joints in the world, by who answered and whether the body is travelling; and the longest time
    unsupported beside mocap's.
    """
    found: dict[tuple[str, str, int, int], list[Row]] = {}
    clips = [clip for each in kinds.values() for clip in each]
    for number, clip in enumerate(clips):
        for length in GAP_LENGTHS:
            for beside in _CONTEXT_LENGTHS:
                row = _evaluate_gap(clip, length, beside, infiller, densities)
                if row is not None:
                    by = row.pop("by").split(" ")[0]
                    found.setdefault((by, row.pop("what"), beside, length), []).append(row)
        if progress is not None:
            progress(number + 1, len(clips))
    return [
        {"by": by, "what": what, "beside": beside, "frames": length, "gaps": len(rows), **_summarise_gaps(rows)}
        for (by, what, beside, length), rows in sorted(found.items())
    ]


def _evaluate_gap(
    clip: Motion, length: int, beside: int, infiller: Inbetweener, densities: Sequence[Density]
) -> Row | None:
    """None for a clip that is too short."""
    if clip.num_frames < length + 2 * beside:
        return None
    first = (clip.num_frames - length) // 2 - beside
    part = clip.slice(first, first + length + 2 * beside)
    free = torch.zeros(part.num_frames, dtype=torch.bool)
    free[beside : beside + length] = True
    lost = MissingMask(free[:, None].expand(-1, part.num_joints).clone(), free)
    done = fill(part, lost, AutoInbetweener(infiller, densities))
    off = (done.motion.joint_positions() - part.joint_positions())[free].norm(dim=-1)
    toes = CANONICAL.indices(TOES)
    slid, mocap = (
        worst_frame.measure_longest_unsupported(each.joint_positions()[:, toes], each.root_position, PRIOR_FPS)
        for each in (done.motion, part)
    )
    what = "going" if is_travelling(part, beside - 1, beside + length) else "in place"
    return {"by": done.sources[0].by, "what": what, "error": 100 * float(off.mean()), "slid": slid, "mocap": mocap}


def _summarise_gaps(rows: Sequence[Row]) -> Row:
    error = torch.tensor([row["error"] for row in rows], dtype=torch.float64)
    slid, mocap = (torch.tensor([row[name] for row in rows]) for name in ("slid", "mocap"))
    return {
        "half_cm": float(error.median()),
        "nine_in_ten_cm": float(error.quantile(0.9)),
        "unsupported_s": float(slid.mean()),
        "worst_s": float(slid.max()),
        "mocap_worst_s": float(mocap.max()),
    }
