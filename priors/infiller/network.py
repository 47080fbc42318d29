"""The infiller: a network that proposes missing frames and joints of a motion (Kaufmann et al. 2020)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.inbetweening import PositionImage, ProposedPositions
from mapctl.inbetweening.position_image import mirror_positions
from mapctl.protocols import PositionInfiller
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.config import NetworkConfig
from priors.infiller.architectures import PAPER_WIDTHS, Architecture, ImageAutoencoder, TemporalUNet

_JOINTS = CANONICAL.num_joints
_POSITION_ROWS, _REFERENCE_ROWS, _CONTACT_ROWS = 3 * _JOINTS, 3, 2
IMAGE_ROWS = _POSITION_ROWS + _REFERENCE_ROWS + _CONTACT_ROWS
"""Rows of an image: joint positions, the reference's velocities, contacts."""
_MASK_ROWS = _JOINTS + 1 + 2  # known, present, frames since and until any joint is known
_VELOCITY_UNIT, _HEADING_UNIT = 0.05, 0.05  # one unit of the reference's velocities: metres and radians a frame
_MAX_FRAMES_SINCE = 60  # frames beyond which it is all one how far a known frame is


@dataclass(frozen=True)
class InfillerConfig(NetworkConfig):
    """Shape of the network."""

    architecture: Architecture = "skips"
    """Architecture: `skips` is ours, which keeps what is known, `image` that of Kaufmann et al. 2020."""
    widths: tuple[int, ...] = (128, 160, 192, 256, 256)
    """Channels of the units of `skips`; those of `image` are fixed."""
    kernel: int = 3
    """Width of a convolution of `skips`, frames."""

    def __post_init__(self):
        if min(self.widths, default=0) < 1 or self.kernel < 1 or self.kernel % 2 == 0:
            raise RequestError(f"an infiller needs positive widths and an odd kernel, got {self}")


class InfillerNetwork(nn.Module):
    """An image in, a proposal out; it normalises inside."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: InfillerConfig, *, bfloat16: bool = False):
        """Compute convolutions in bfloat16 if so asked; what they are given and give back is not."""
        super().__init__()
        self.config, self.reduced_precision = config, bfloat16
        self.register_buffer("mean", torch.zeros(_JOINTS, 3))
        self.register_buffer("std", torch.ones(_JOINTS, 3))
        self.keeps_observed = config.architecture == "skips"
        if self.keeps_observed:
            self.net = TemporalUNet(
                IMAGE_ROWS + _MASK_ROWS, _POSITION_ROWS + _CONTACT_ROWS, config.widths, config.kernel
            )
        else:
            self.net = ImageAutoencoder(PAPER_WIDTHS)

    def forward(self, image: PositionImage) -> ProposedPositions:
        """Fill an image; ours keeps known positions to the bit, an autoencoder makes all anew (Kaufmann et al. 2020,
        section 4.2)."""
        shown = self._show(image)
        rows = self._rows(image, shown)
        rows = torch.cat([rows, _encode_masks(image)], dim=-1) if self.keeps_observed else rows
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=self.reduced_precision):
            out = self.net(rows.transpose(1, 2)).transpose(1, 2).to(rows.dtype)
        change, contacts = (
            out[..., :_POSITION_ROWS].unflatten(-1, (_JOINTS, 3)) * self.std,
            4 * out[..., -_CONTACT_ROWS:],
        )
        if not self.keeps_observed:
            return ProposedPositions(self.mean + change, contacts)
        return ProposedPositions(torch.where(image.known[..., None], image.places, shown + change), contacts)

    def _show(self, image: PositionImage) -> Float[Tensor, "batch frames joints 3"]:
        """Return the image's places, with joints that are never known at their mean."""
        return torch.where(image.ever_known[:, None, :, None], image.places, self.mean)

    def _rows(self, image: PositionImage, shown: Tensor) -> Float[Tensor, "batch frames rows"]:
        """Encode the image in about unit size; an autoencoder's unknown positions are 0, their mean (section 3.3)."""
        places = (shown - self.mean) / self.std
        if not self.keeps_observed:
            places = places * image.known[..., None]
        places = places * image.present[..., None, None]
        step = torch.diff(image.ground, dim=1, prepend=image.ground[:, :1])
        step = rotations.rotate_ground(step, -image.heading) / _VELOCITY_UNIT
        turn = torch.diff(image.heading, dim=1, prepend=image.heading[:, :1])[..., None] / _HEADING_UNIT
        return torch.cat([places.flatten(-2), step, turn, 2 * image.contacts - 1], dim=-1)


def _encode_masks(image: PositionImage) -> Float[Tensor, "batch frames told"]:
    """Encode which joints are known, and how many frames ago and ahead any is."""
    some = image.known.any(dim=-1)
    far = torch.stack([_count_frames_since(some), _count_frames_since(some.flip(1)).flip(1)], dim=-1)
    return torch.cat([image.known.to(far), image.present[..., None].to(far), far], dim=-1)


def _count_frames_since(known: Tensor) -> Float[Tensor, "batch frames"]:
    """Count frames since a known one, as a share of those that matter; 1 where there was none."""
    frame = torch.arange(known.shape[1], device=known.device)
    last = torch.where(known, frame, -_MAX_FRAMES_SINCE).cummax(dim=1).values
    return (frame - last).clamp(max=_MAX_FRAMES_SINCE) / _MAX_FRAMES_SINCE


@dataclass(frozen=True, eq=False, repr=False)
class ConvInfiller(checkpoints.LoadedModel, PositionInfiller):
    """A trained infiller."""

    name: str
    """Name under which it was loaded."""
    network: InfillerNetwork
    """Network in evaluation mode."""
    card: checkpoints.Card
    """Card of the weights."""

    @torch.no_grad()
    def complete(self, image: PositionImage) -> ProposedPositions:
        """Propose the whole motion, of any length: the mean of the outputs for it and for its mirror image."""
        one, other = self.network(image), self.network(image.mirrored())
        places = (one.places + mirror_positions(other.places)) / 2
        contacts = (one.contacts + other.contacts.flip(-1)) / 2
        return ProposedPositions(
            torch.where(image.known[..., None] & self.network.keeps_observed, image.places, places), contacts
        )


def load(name: str) -> ConvInfiller:
    """Load a trained infiller by its file or run folder; CheckpointError for anything else."""
    with checkpoints.open_checkpoint(name, "infiller") as (tensors, card):
        network = checkpoints.build_network(InfillerNetwork, InfillerConfig.of_card(card.config), tensors)
    return ConvInfiller(name, network, card)
