"""Unknowns about a given motion: how far each frame's pose and place are from it, in sigmas, smooth in time.

x = guide + sigma * (K z): the posterior of a model that proposes whole motions, as a rollout's x = mu + sigma d is that
of a density. K smooths white z to unit variance, so that a correction of one frame moves its neighbours along. Places
are in the world, not steps from frame to frame: terms that hold the motion where it was seen are then well conditioned.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose
from mapctl.numerics import gaussian
from mapctl.skeleton import Skeleton
from mapctl.terms.trial import Trial


@dataclass(frozen=True, eq=False)
class Guide:
    """A motion in the world: what the unknowns are about."""

    root: Float[Tensor, "frames 3"]
    """Of the hips, metres."""
    heading: Float[Tensor, " frames"]
    """Radians, not wrapped."""
    angles: Float[Tensor, "frames angles"]
    """The hips' tilt (2) and the rotation vectors of all other joints, radians."""
    contacts: Bool[Tensor, "frames 2"]
    """Left and right toe planted."""

    def slice(self, start: int, stop: int) -> "Guide":
        """Frames start to stop."""
        part = slice(start, stop)
        return Guide(self.root[part], self.heading[part], self.angles[part], self.contacts[part])

    def packed(self) -> Float[Tensor, "frames width"]:
        """Root, heading and angles side by side."""
        return torch.cat([self.root, self.heading[:, None], self.angles], dim=-1)


@dataclass(frozen=True, eq=False)
class PoseOffsets:
    """Builds trials from unknowns about a guide."""

    guide: Guide
    """Of the window."""
    sigma: Float[Tensor, "frames width"]
    """Of root, heading and angles (see `Guide.packed`): metres and radians."""
    place: GroundPose
    """Of the frame before the window."""
    before: Float[Tensor, "past joints 3"]
    """World joint positions of the last frames before it, metres."""
    contacts_before: Bool[Tensor, "2"]
    """Of the frame before it."""
    skeleton: Skeleton
    """Bones of the performer."""
    smooth: float = 2.0
    """Sigma of the smoothing, frames."""
    density: Any = None
    """A density that scores the motion with teacher forcing (Eq. 15), or None."""
    state: Any = None
    """Its state before the window."""

    @cached_property
    def _smoothing_matrix(self) -> Float[Tensor, "frames frames"]:
        weight = gaussian.pairwise_weights(len(self.sigma), self.smooth, self.sigma.dtype)
        return weight / weight.square().sum(dim=-1, keepdim=True).sqrt()

    def build(self, unknowns: Float[Tensor, "batch unknowns"]) -> Trial:
        """The guide, changed."""
        white = unknowns.unflatten(-1, tuple(self.sigma.shape))
        packed = self.guide.packed() + self.sigma * torch.einsum("ts,bsw->btw", self._smoothing_matrix, white)
        features = self._encode_features(packed)
        density = features.new_zeros(features.shape[:2])
        if self.density is not None:
            density = self.density.log_prob(features, self.state)
        bits = self.guide.contacts.expand(len(white), -1, -1)
        return Trial(
            features, self.place, white, density, bits, self.before, self.skeleton, PRIOR_FPS, self.contacts_before
        )

    def _encode_features(self, packed: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames size"]:
        """Steps and turns from places and headings."""
        batch = len(packed)
        ground, heading = packed[..., [0, 2]], packed[..., 3]
        ground = torch.cat([self.place.position_xz.expand(batch, 1, 2), ground], dim=1)
        heading = torch.cat([self.place.heading.expand(batch, 1), heading], dim=1)
        step = rotations.rotate_ground(torch.diff(ground, dim=1), -heading[:, :-1])
        turn = torch.diff(heading, dim=1)[..., None]
        bits = self.guide.contacts.expand(batch, -1, -1).to(packed)
        features = torch.cat([step, turn, packed[..., 1:2], packed[..., 4:], bits], dim=-1)
        assert features.shape[-1] == LAYOUT.size
        return features
