"""The infiller: a network that proposes missing frames and joints of a motion (Kaufmann et al. 2020)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, max_pool2d

from mapctl import rotations
from mapctl.inbetweening import GapQuery, PositionImage, Proposal, ProposedPositions
from mapctl.inbetweening.position_image import mirror_positions, propose_from_positions
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Sizes

_LEAK = 0.2


class ImageAutoencoder(nn.Module):
    """The autoencoder of Kaufmann et al. 2020: 3x3 filters over rows and frames, pooling, strided de-convolutions."""

    def __init__(self, widths: tuple[int, ...]):
        super().__init__()
        ins = (1, *widths[:-1])
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip(ins, widths, strict=True))
        self.down_two = nn.ModuleList(nn.Conv2d(b, b, 3, padding=1) for b in widths)
        ups = list(zip(reversed(widths), reversed(ins), strict=True))
        self.up = nn.ModuleList(nn.ConvTranspose2d(b, b, 2, stride=2) for b, _ in ups)
        self.up_two = nn.ModuleList(nn.Conv2d(b, a, 3, padding=1) for b, a in ups)
        for parameter in self.parameters():  # as Glorot and Bengio 2010 (Kaufmann et al. 2020, section 3.3)
            _ = nn.init.xavier_uniform_(parameter) if parameter.dim() > 1 else nn.init.zeros_(parameter)

    def forward(self, rows: Float[Tensor, "batch rows frames"]) -> Float[Tensor, "batch rows frames"]:
        """Return the rows anew."""
        hidden, sizes = rows[:, None], []
        for one, two in zip(self.down, self.down_two, strict=True):
            sizes.append(hidden.shape[-2:])
            hidden = leaky_relu(two(leaky_relu(one(hidden), _LEAK)), _LEAK)
            hidden = max_pool2d(hidden, 2, ceil_mode=True)
        for level, (one, two, size) in enumerate(zip(self.up, self.up_two, reversed(sizes), strict=True)):
            hidden = two(leaky_relu(one(hidden)[..., : size[0], : size[1]], _LEAK))
            hidden = hidden if level == len(self.up) - 1 else leaky_relu(hidden, _LEAK)
        return hidden[:, 0]


_JOINTS = CANONICAL.num_joints
_VELOCITY_UNIT, _HEADING_UNIT = 0.05, 0.05  # one unit of the reference's velocities: metres and radians a frame


@dataclass(frozen=True)
class InfillerConfig(NetworkConfig):
    """Shape of the network."""

    widths: Sizes = (32, 64, 128, 256, 256)
    """Channels of each unit: of 240 frames are left 3 x 8 x 256 numbers (Kaufmann et al. 2020, section 3.2)."""


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
        self.net = ImageAutoencoder(config.widths)

    def forward(self, image: PositionImage) -> ProposedPositions:
        """Generate all positions of an image anew, the known ones too (section 4.2)."""
        # Unknown positions are 0, their mean (section 3.3).
        shown = (image.positions - self.mean) / self.std * image.known[..., None]
        step = torch.diff(image.ground, dim=1, prepend=image.ground[:, :1])
        step = rotations.rotate_ground(step, -image.heading) / _VELOCITY_UNIT
        turn = torch.diff(image.heading, dim=1, prepend=image.heading[:, :1])[..., None] / _HEADING_UNIT
        rows = torch.cat([shown.flatten(-2), step, turn, 2 * image.contacts - 1], dim=-1)
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=self.reduced_precision):
            out = self.net(rows.transpose(1, 2)).transpose(1, 2).to(rows.dtype)
        positions = self.mean + self.std * out[..., : 3 * _JOINTS].unflatten(-1, (_JOINTS, 3))
        return ProposedPositions(positions, 4 * out[..., -2:])


@dataclass(frozen=True, eq=False, repr=False)
class ConvInfiller(checkpoints.NetworkModel[InfillerNetwork], Inbetweener):
    """A trained infiller."""

    kind, parts = "infiller", (InfillerNetwork, InfillerConfig)

    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose a motion of rigid bones near the positions of `complete`."""
        return propose_from_positions(query, self.complete, self.kind)

    @torch.no_grad()
    def complete(self, image: PositionImage) -> ProposedPositions:
        """Propose the whole motion, of any length: the mean of the outputs for it and for its mirror image."""
        one, other = self.network(image), self.network(image.mirrored())
        positions = (one.positions + mirror_positions(other.positions)) / 2
        return ProposedPositions(positions, (one.contacts + other.contacts.flip(-1)) / 2)
