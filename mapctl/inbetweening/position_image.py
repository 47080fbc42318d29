"""Position images: a motion with gaps as joint positions by frame (infilling paper, section 3.1).

The paper looks at every frame from its own root, and gives the way of the root by its velocities. In a gap the root is
not known, and the integral of proposed velocities does not end where the motion goes on. So positions here are seen
from a reference that is the root where it is known and a guess at it where it is not (straight from one known root to
the next): what is proposed fits both ends.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.skeleton import CANONICAL

_PARTNERS = CANONICAL.mirror_partners()


@dataclass(frozen=True, eq=False)
class PositionImage:
    """A batch of motions of one length, on canonical joints at the prior's rate. Joint 0 is the hips."""

    places: Float[Tensor, "batch frames joints 3"]
    """Seen from the reference, metres; unknown ones are a guess, as what slerp makes of the joints' rotations."""
    contacts: Float[Tensor, "batch frames 2"]
    """Left and right toe planted, 0 or 1; 0.5 where the toe is not known."""
    known: Bool[Tensor, "batch frames joints"]
    """Whether a joint's place is known."""
    present: Bool[Tensor, "batch frames"]
    """Whether there is such a frame; others fill up a batch."""
    ground: Float[Tensor, "batch frames 2"]
    """Where the reference stands (x, z), world, metres."""
    heading: Float[Tensor, "batch frames"]
    """Which way it faces about +Y, radians."""

    @staticmethod
    def of_world(
        places_world: Float[Tensor, "batch frames joints 3"],
        heading: Float[Tensor, "batch frames"],
        contacts: Float[Tensor, "batch frames 2"],
        *,
        known: Bool[Tensor, "batch frames joints"],
        present: Bool[Tensor, "batch frames"],
        toes: tuple[int, int],
    ) -> "PositionImage":
        """From world positions (metres) and the hips' heading (radians), guesses where they are not known; the
        reference is their root. Contacts of toes that are not known may be anything finite.
        """
        known = known & present[..., None]
        bits = torch.where(known[..., list(toes)], contacts, 0.5)
        ground, facing = places_world[..., 0, ::2], rotations.unwrap_angle(heading)
        image = PositionImage(places_world, bits, known, present, ground, facing)
        return replace(image, places=image.from_world(places_world))

    def from_world(self, places_world: Float[Tensor, "batch frames joints 3"]) -> Tensor:
        """World positions seen from the reference."""
        ground = places_world[..., ::2] - self.ground[..., None, :]
        return _replace_ground(places_world, rotations.rotate_ground(ground, -self.heading[..., None]))

    def to_world(self, places: Float[Tensor, "batch frames joints 3"]) -> Tensor:
        """Inverse of `from_world`."""
        ground = rotations.rotate_ground(places[..., ::2], self.heading[..., None])
        return _replace_ground(places, ground + self.ground[..., None, :])

    def mirrored(self) -> "PositionImage":
        """Left and right exchanged."""
        flip = self.ground.new_tensor([-1.0, 1.0])
        return PositionImage(
            mirror_positions(self.places),
            self.contacts.flip(-1),
            self.known[..., _PARTNERS],
            self.present,
            self.ground * flip,
            -self.heading,
        )

    @property
    def ever_known(self) -> Bool[Tensor, "batch joints"]:
        """Whether a joint is known in any frame."""
        return self.known.any(dim=1)


@dataclass(frozen=True, eq=False)
class ProposedPositions:
    """What an in-betweener makes of an image."""

    places: Float[Tensor, "batch frames joints 3"]
    """Of all joints, seen from the image's reference, metres. Bones may have changed their lengths a little."""
    contacts: Float[Tensor, "batch frames 2"]
    """Log odds that the left and the right toe are planted."""


def mirror_positions(places: Float[Tensor, "*batch joints 3"]) -> Float[Tensor, "*batch joints 3"]:
    """Seen in a mirror that stands along the reference's way."""
    return places[..., _PARTNERS, :] * places.new_tensor([-1.0, 1.0, 1.0])


def _replace_ground(places: Float[Tensor, "batch frames joints 3"], ground: Float[Tensor, "batch frames joints 2"]):
    """The same heights over other places on the ground."""
    return torch.stack([ground[..., 0], places[..., 1], ground[..., 1]], dim=-1)
