"""Errors over the frames of a gap, of several answers to it (Ren et al. 2024, figure 6)."""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.transitions.methods import Sampler
from controllers.benchmarks.transitions.windows import Gap, find_gaps, put_in
from mapctl.motion import Motion

ANSWERS = 3
"""Answers to each gap."""


def benchmark_over_time(
    kinds: Mapping[str, Sequence[Motion]],
    samplers: Mapping[str, Sampler],
    *,
    past: int | None,
    length: int = 30,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure by sampler and frame of gaps of so many frames the mean distance of joints from their true places, cm: of
    ANSWERS answers on average, and of the one that is nearest in that frame and the one that is farthest. Means of
    kinds (clips canonical, of canonical bones, at PRIOR_FPS).
    """
    gaps = {kind: [gap for clip in clips for gap in find_gaps(clip, length, past)] for kind, clips in kinds.items()}
    gaps, rows = {kind: each for kind, each in gaps.items() if each}, []
    for number, (name, sampler) in enumerate(samplers.items()):
        of_kinds = [torch.stack([_measure(sampler, gap) for gap in each]).mean(dim=0) for each in gaps.values()]
        for frame, (mean, least, most) in enumerate(torch.stack(of_kinds).mean(dim=0).tolist(), 1):
            rows.append({"by": name, "frame": frame, "error_cm": mean, "nearest_cm": least, "farthest_cm": most})
        if progress is not None:
            progress(number + 1, len(samplers))
    return rows


def _measure(sampler: Sampler, gap: Gap) -> Float[Tensor, "frames 3"]:
    """Measure the mean, least and largest error of the answers to one gap, cm."""
    truth = gap.around.joint_positions()[gap.filled]
    made = [put_in(each, gap).joint_positions()[gap.filled] for each in sampler(gap.part, gap.start, gap.stop, ANSWERS)]
    errors = 100 * (torch.stack(made) - truth).norm(dim=-1).mean(dim=-1)
    return torch.stack([errors.mean(dim=0), errors.amin(dim=0), errors.amax(dim=0)], dim=1)
