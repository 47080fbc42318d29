"""What the generator is told: whole poses at keys, seen from a reference that leads straight from key to key."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.numerics.intervals import fill_missing, fill_missing_angle
from mapctl.skeleton import CANONICAL, TOE_JOINTS


def make_key_image(motion: PartialMotion, known: Bool[Tensor, "batch frames"]) -> PositionImage:
    """Make the image of whole poses in some frames; elsewhere the motion may hold anything finite."""
    places = motion.world_poses()[0]
    root = fill_missing(motion.root_position, known)
    return PositionImage.of_world(
        places - motion.root_position[:, :, None] + root[:, :, None],
        fill_missing_angle(motion.heading, known),
        see_contacts(motion.contacts, known),
        known=known[..., None].expand(*known.shape, CANONICAL.num_joints),
        present=torch.ones_like(known),
        toes=TOE_JOINTS,
    )


def see_contacts(
    contacts: Float[Tensor, "batch frames 2"], known: Bool[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames 2"]:
    """Forget contacts, as 0.5, where no frame beside is known: a single pose does not tell whether its toes move."""
    off = torch.zeros_like(known[:, :1])
    beside = torch.cat([off, known[:, :-1]], dim=1) | torch.cat([known[:, 1:], off], dim=1)
    return torch.where((known & beside)[..., None], contacts, 0.5)
