"""Diversity of samples: their average pairwise distance (Ren et al. 2024, section 5.1)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.metrics.realism.windows import HIPS, canonical_positions, facing_angle, transform_to_ground_frame
from mapctl.motion import Motion

_CM = 100.0


class Diversity(NamedTuple):
    """Average pairwise distance of samples."""

    world_cm: float
    """Distance between the joints in the world, centimetres: of trajectories and poses."""
    root_aligned_cm: float
    """Distance between the joints relative to the hips and facing of each frame, centimetres: of poses and timing."""


def measure_diversity(samples: Sequence[Motion]) -> Diversity:
    """Measure diversity of several samples from one start (any known rig); RequestError for fewer than two, or other
    lengths."""
    lengths = sorted({sample.num_frames / sample.fps for sample in samples})
    if len(samples) < 2 or len(lengths) > 1:
        shown = " and ".join(f"{float(length):.4g}" for length in lengths)
        raise RequestError(f"diversity needs at least 2 samples of one length, got {len(samples)} of {shown} s")
    return measure_position_diversity(torch.stack([canonical_positions(sample) for sample in samples]))


def measure_position_diversity(positions: Float[Tensor, "samples frames joints 3"]) -> Diversity:
    """Measure diversity from world positions of the canonical joints, metres."""
    aligned = torch.stack([_align_to_root(sample) for sample in positions])
    return Diversity(average_pairwise_distance(positions) * _CM, average_pairwise_distance(aligned) * _CM)


def align_to_start(positions: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames joints 3"]:
    """Move a clip to begin at the origin facing +Z, to compare clips that did not begin at one position."""
    return transform_to_ground_frame(positions, positions[:1, HIPS, ::2], facing_angle(positions)[:1])


def average_pairwise_distance(positions: Float[Tensor, "samples frames joints 3"]) -> float:
    """Return the mean over pairs of samples, frames and joints of the distance between joints, in the unit of
    `positions`."""
    samples, frames, joints, _ = positions.shape
    # frame by frame, for the distances of a thousand samples at once would need gigabytes
    total = sum(float(torch.cdist(at, at).sum()) for at in positions.permute(1, 2, 0, 3))
    return total / (samples * (samples - 1) * frames * joints)


def _align_to_root(positions: Float[Tensor, "frames joints 3"]) -> Float[Tensor, "frames joints 3"]:
    relative = transform_to_ground_frame(positions, positions[:, HIPS, ::2], facing_angle(positions))
    return relative - relative[:, HIPS : HIPS + 1]
