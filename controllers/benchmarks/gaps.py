"""Benchmark of gaps: errors of proposals by in-betweener and length of the gap, from which notes on gaps are made."""

from collections.abc import Callable, Mapping, Sequence

import torch

from controllers.benchmarks.shared.tables import Row
from controllers.inbetweening.gap_notes import is_travelling
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
    inbetweener: Inbetweener,
    densities: Sequence[Density],
    *,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Fill gaps in the middle of clips (canonical, at PRIOR_FPS): quantiles over clips of the mean error of all joints
    in the world, by in-betweener and by whether the body is travelling; and the longest unsupported time beside
    mocap's.
    """
    found: dict[tuple[str, str, int, int], list[Row]] = {}
    clips = [clip for each in kinds.values() for clip in each]
    for number, clip in enumerate(clips):
        for length in GAP_LENGTHS:
            for context in _CONTEXT_LENGTHS:
                row = _evaluate_gap(clip, length, context, inbetweener, densities)
                if row is not None:
                    by = row.pop("by").split(" ")[0]
                    found.setdefault((by, row.pop("what"), context, length), []).append(row)
        if progress is not None:
            progress(number + 1, len(clips))
    return [
        {"by": by, "what": what, "beside": context, "frames": length, "gaps": len(rows), **_summarise_gaps(rows)}
        for (by, what, context, length), rows in sorted(found.items())
    ]


def _evaluate_gap(
    clip: Motion, length: int, context: int, inbetweener: Inbetweener, densities: Sequence[Density]
) -> Row | None:
    """Measure one gap of a clip; None for a clip that is too short."""
    if clip.num_frames < length + 2 * context:
        return None
    first = (clip.num_frames - length) // 2 - context
    part = clip.slice(first, first + length + 2 * context)
    free = torch.zeros(part.num_frames, dtype=torch.bool)
    free[context : context + length] = True
    missing = MissingMask.of_frames(free, part.num_joints)
    done = fill(part, missing, AutoInbetweener(inbetweener, densities))
    errors = (done.motion.joint_positions() - part.joint_positions())[free].norm(dim=-1)
    toes = CANONICAL.indices(TOES)
    unsupported, mocap = (
        worst_frame.measure_longest_unsupported(each.joint_positions()[:, toes], each.root_position, PRIOR_FPS)
        for each in (done.motion, part)
    )
    what = "going" if is_travelling(part, context - 1, context + length) else "in place"
    error = 100 * float(errors.mean())
    return {"by": done.sources[0].by, "what": what, "error": error, "unsupported": unsupported, "mocap": mocap}


def _summarise_gaps(rows: Sequence[Row]) -> Row:
    error = torch.tensor([row["error"] for row in rows], dtype=torch.float64)
    unsupported, mocap = (torch.tensor([row[name] for row in rows]) for name in ("unsupported", "mocap"))
    return {
        "half_cm": float(error.median()),
        "nine_in_ten_cm": float(error.quantile(0.9)),
        "unsupported_s": float(unsupported.mean()),
        "worst_s": float(unsupported.max()),
        "mocap_worst_s": float(mocap.max()),
    }
