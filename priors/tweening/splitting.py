"""Gaps beyond the network's field: poses on the way split them (Zhou et al. 2020, section 4.9, name a hierarchy as the
remedy).

A pose is one of the style's, or of the keys beside the gap where no style brings any. It is told to the network like a
key, at its place on the reference's way from key to key and turned to the heading there; motion comes near it and need
not meet it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import kinematics, rotations
from mapctl.inbetweening import GapQuery
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors.tweening.generator import MAX_KEY_FRAMES

PART_FRAMES = MAX_KEY_FRAMES // 2
"""Frames of the longest part of a gap that is split."""


@dataclass(frozen=True, eq=False)
class Split:
    """A gap that is longer than the network sees, and frames in it at which poses are told."""

    start: int
    """First frame of the gap."""
    stop: int
    """One past its last."""

    @property
    def frames(self) -> list[int]:
        """Frames at which poses are told, evenly from edge to edge."""
        parts = -(-(self.stop - self.start) // PART_FRAMES)
        return [self.start + round(part * (self.stop - self.start) / parts) for part in range(1, parts)]


def find_splits(query: GapQuery) -> Iterator[Split]:
    """Yield the gaps in which nothing is known and that are longer than the network sees."""
    for _, start, stop in true_intervals(query.nothing_known[:, None]):
        if stop - start > MAX_KEY_FRAMES:
            yield Split(start, stop)


def show_edges(query: GapQuery, split: Split) -> Float[Tensor, "poses joints 3"]:
    """Return the whole poses next to a gap, the one after it first, as motion DNA has them: metres from the hips,
    without the hips' rotation, of unit size. None where no pose is whole."""
    whole = (~query.missing.frames).nonzero()[:, 0]
    after, before = whole[whole >= split.stop], whole[whole < split.start]
    beside = torch.cat([after[:1], before[-1:]])
    upright = query.motion.local_quat_xyzw[beside].clone()
    upright[:, 0] = upright.new_tensor([0.0, 0.0, 0.0, 1.0])
    return kinematics.positions_from_matrices(CANONICAL, rotations.to_matrix(upright)).float()


def place_poses(
    poses: Float[Tensor, "poses joints 3"], body: Motion, frames: Sequence[int]
) -> Float[Tensor, "frames joints 3"]:
    """Place poses in these frames of a body that is led from key to key, turned to its heading there, the lower
    toe on the floor; spread over all of them, or one after the other and all over again if there are fewer. Metres,
    world."""
    count, there_are = len(frames), len(poses)
    picked = [one * there_are // count if count < there_are else one % there_are for one in range(count)]
    chosen = poses[picked].double()
    facing = heading(body.local_quat_xyzw[frames, 0])
    turned = rotations.rotate_about_y(chosen, facing[:, None])
    ground = body.root_position[frames] * torch.tensor([1.0, 0.0, 1.0]).double()
    lift = TOE_REST_HEIGHT - turned[:, list(TOE_JOINTS), 1].amin(dim=1)
    return turned + ground[:, None] + lift[:, None, None] * torch.tensor([0.0, 1.0, 0.0]).double()
