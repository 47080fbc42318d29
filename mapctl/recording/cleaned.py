"""What a denoiser makes of a capture."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A proposal for the motion behind a batch of captures, and its contacts."""

    root: Float[Tensor, "batch frames 3"]
    """Of the hips, world, metres."""
    heading: Float[Tensor, "batch frames"]
    """Of the hips about +Y, radians, not wrapped."""
    angles: Float[Tensor, "batch frames angles"]
    """The hips' tilt (2) and the rotation vectors of all other joints, as in the features."""
    contacts: Float[Tensor, "batch frames 2"]
    """Log odds of the left and right toe being planted."""

    @cached_property
    def local_quat_xyzw(self) -> Float[Tensor, "batch frames joints 4"]:
        """Local rotations of all joints."""
        tilt = torch.stack([self.angles[..., 0], torch.zeros_like(self.heading), self.angles[..., 1]], dim=-1)
        hips = rotations.multiply(rotations.about_y(self.heading), rotations.from_rotation_vector(tilt))
        others = rotations.from_rotation_vector(self.angles[..., 2:].unflatten(-1, (-1, 3)))
        return torch.cat([hips.unsqueeze(-2), others], dim=-2)
