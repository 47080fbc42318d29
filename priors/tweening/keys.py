"""What the generator is told: poses or parts of them at keys, seen from a reference that leads from key to key."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.loose_keys import lead_over_places
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from priors.tweening.walked_way import bend_way


@dataclass(frozen=True, eq=False)
class ToldParts:
    """What keys tell; a frame that tells nothing is none."""

    axes: Bool[Tensor, "batch frames joints 3"]
    """Which coordinates of joints are told, in the reference's axes. Of the hips x and z are their place on the ground;
    coordinates of the others are seen from there, heights from the floor."""
    heading: Bool[Tensor, "batch frames"]
    """Whether the hips' heading is told."""
    view: Float[Tensor, " batch"]
    """Heading of a reference that does not turn, radians, for what is drawn from one side; NaN where it leads from key
    to key."""

    @staticmethod
    def whole(known: Bool[Tensor, "batch frames"]) -> "ToldParts":
        """Tell the whole poses of some frames."""
        axes = known[..., None, None].expand(*known.shape, CANONICAL.num_joints, 3)
        return ToldParts(axes, known, torch.full((len(known),), torch.nan))

    @property
    def known(self) -> Bool[Tensor, "batch frames"]:
        """Frames in which anything is told."""
        return self.axes.flatten(2).any(dim=-1)

    @property
    def placed(self) -> Bool[Tensor, "batch frames"]:
        """Frames in which the hips' place on the ground is told."""
        return self.axes[..., 0, 0] & self.axes[..., 0, 2]


def make_key_image(motion: PartialMotion, told: ToldParts) -> PositionImage:
    """Make the image of what is told of some frames; the rest of the motion may hold anything finite."""
    places = motion.world_poses()[0]
    ground, heading = lead_reference(motion.root_position[..., ::2], motion.heading, told)
    shift = rotations.lift_ground(ground - motion.root_position[..., ::2])
    return PositionImage.of_world(
        places + shift[:, :, None],
        heading,
        see_contacts(motion.contacts, told.known),
        known=told.axes.all(dim=-1),
        present=torch.ones_like(told.heading),
        toes=TOE_JOINTS,
        known_axes=told.axes,
    )


def lead_reference(
    ground: Float[Tensor, "batch frames 2"], heading: Float[Tensor, "batch frames"], told: ToldParts
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Lead the reference (ground, metres; heading, radians) from told place to told place, and from told heading to
    told heading: as who walks would (`bend_way`) where that is clear, else straight and evenly. Where a sequence tells
    no heading, it looks along its way."""
    # What is drawn stands where its hips are, also if only one axis of these is told.
    shown = told.axes[..., 0, :].any(dim=-1)
    way, facing = lead_over_places(ground, heading, placed=shown, faced=told.heading)
    drawn = torch.isfinite(told.view)[:, None]
    way, facing = bend_way(way, facing, placed=shown, faced=told.heading & ~drawn)
    return way, torch.where(drawn, torch.nan_to_num(told.view)[:, None], facing)


def see_contacts(
    contacts: Float[Tensor, "batch frames 2"], known: Bool[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames 2"]:
    """Forget contacts, as 0.5, where no frame beside is known: a single pose does not tell whether its toes move."""
    off = torch.zeros_like(known[:, :1])
    beside = torch.cat([off, known[:, :-1]], dim=1) | torch.cat([known[:, 1:], off], dim=1)
    return torch.where((known & beside)[..., None], contacts, 0.5)
