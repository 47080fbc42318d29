"""Benchmark of keys of many clips, one after the other (Zhou et al. 2020, table 4, appendix C): how far they are missed
before they are made exact.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controllers.benchmarks.shared.tables import Row
from controllers.benchmarks.tweener.gap_measures import Method, query_gaps
from controllers.inbetweening.infill import infill
from controllers.inbetweening.pipeline import InfillSettings
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.recording.masks import ALL, Mask

_COLUMNS = ("joints_cm", "hips_cm", "hips_from_first_cm", "hips_between_cm", "exact_cm")


@dataclass(frozen=True, eq=False)
class KeySequence:
    """Keys of several clips, on canonical bones at PRIOR_FPS."""

    motion: Motion
    """Poses at keys; elsewhere it may be anything."""
    known: Bool[Tensor, " frames"]
    """Whether a frame is a key."""
    truthful: Bool[Tensor, " frames"]
    """Whether a frame is a performer's, as between keys of one clip."""
    clip: Int[Tensor, " frames"]
    """Number of the clip that a key is of."""

    def gaps(self) -> list[tuple[int, int]]:
        """Return first frames of the gaps between keys, and one past their last."""
        enclosed = ((start, stop) for _, start, stop in true_intervals(~self.known[:, None]))
        return [(start, stop) for start, stop in enclosed if start > 0 and stop < len(self.known)]

    def fill(self, method: Method) -> Motion:
        """Fill all gaps."""
        masks = [Mask(ALL, start, stop) for _, start, stop in true_intervals(~self.known[:, None])]
        return infill(self.motion, method.inbetweener, masks, settings=method.settings).motion


def benchmark_spliced_keys(
    sequences: Iterable[KeySequence],
    methods: Sequence[Method],
    *,
    count: int,
    progress: Callable[[int, int], None] | None = None,
) -> list[Row]:
    """Measure keys of methods that have a raw proposal, mean over all keys, cm: joints seen from the hips; the hips
    after a sequence's mean offset is taken out (Eq. 10), from its first key on, and from each key to the next; and all
    joints in the world once keys are made exact. There are `count` sequences, of which one is held at a time."""
    raw = [method for method in methods if method.raw is not None]
    sums, keys = torch.zeros(len(raw), len(_COLUMNS)).double(), 0
    for done, sequence in enumerate(sequences, start=1):
        own = int(sequence.known.sum())
        for number, method in enumerate(raw):
            sums[number] += own * _miss_keys(sequence, method)
        keys += own
        if progress is not None:
            progress(done, count)
    means = (sums / max(1, keys)).tolist()
    told = {"sequences": count, "keys": keys}
    return [
        {"by": method.name, **told, **dict(zip(_COLUMNS, found, strict=True))}
        for method, found in zip(raw, means, strict=True)
    ]


def _miss_keys(sequence: KeySequence, method: Method) -> Float[Tensor, " measures"]:
    assert method.raw is not None
    known, motion = sequence.known, sequence.motion
    raw, true = method.raw(query_gaps(motion, known))[known], motion.joint_positions()[known]
    off, joints = (raw - true)[:, 0], (raw - raw[:, :1]) - (true - true[:, :1])
    exact = Method(method.name, method.inbetweener, InfillSettings(finish=False))
    missed = sequence.fill(exact).joint_positions()[known] - true
    between = torch.diff(off, dim=0)
    each = (joints[:, 1:], off - off.mean(dim=0), off - off[:1], between if len(between) else off[:1] * 0, missed)
    return 100 * torch.stack([part.norm(dim=-1).mean() for part in each])
