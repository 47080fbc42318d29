"""What one group of inputs tells alone: accuracy of networks that are given nothing else."""

from collections.abc import Callable, Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.metrics.realism.classifier import ClassifierSettings, compute_held_out_accuracy
from mapctl.metrics.realism.evidence.parts import BANDS, JOINTS, cut_parts, join_bone, join_parts
from mapctl.metrics.realism.evidence.paths import INPUTS
from mapctl.metrics.realism.windows import WindowSettings

GROUPS = (*BANDS, *JOINTS, *INPUTS)
"""Groups that are measured alone."""


def measure_alone(
    made: Sequence[Float[Tensor, "_ joints 3"]],
    mocap: Sequence[Float[Tensor, "_ joints 3"]],
    *,
    windows: WindowSettings,
    classifier: ClassifierSettings,
    seed: int,
    tick: Callable[[], None] = lambda: None,
) -> dict[str, float]:
    """Measure the balanced held-out accuracy by each of GROUPS alone, on the same folds for all.

    A joint is its place and velocity from the joint above it, a band the whole body's motion in it. What a group tells
    alone and what is lost without it are different questions where groups know the same: so both are asked.
    `made` and `mocap` are `canonical_positions` of each clip.
    """
    parts = [[cut_parts(clip, windows) for clip in clips] for clips in (made, mocap)]
    found = {}
    for name, *sets in zip(GROUPS, *(_pick_groups(clips) for clips in parts), strict=True):
        generator = torch.Generator().manual_seed(seed)
        found[name] = compute_held_out_accuracy(*sets, generator=generator, settings=classifier)
        tick()
    return found


def _pick_groups(
    clips: Sequence[Float[Tensor, "_ bands frames_and_one joints 3"]],
) -> Iterator[list[Float[Tensor, "_ frames channels"]]]:
    """Yield the channels of each of GROUPS, by clip."""
    for band in range(len(BANDS)):
        yield [join_parts(clip[:, band]) for clip in clips]
    bones = [clip.sum(dim=1) for clip in clips]
    for joint in range(len(JOINTS)):
        yield [join_bone(clip[:, :, joint]) for clip in bones]
    for kind in range(len(INPUTS)):
        yield [join_parts(clip).unflatten(-1, (len(INPUTS), -1))[:, :, kind] for clip in bones]
