"""The infiller: a network that proposes missing frames and joints of a motion (Kaufmann et al. 2020)."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, max_pool1d, max_pool2d

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.inbetweening import GapQuery, PositionImage, Proposal, ProposedPositions
from mapctl.inbetweening.position_image import mirror_positions, propose_from_positions
from mapctl.numerics.intervals import count_frames_to_observed
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Size, Sizes

Architecture = Literal["skips", "image"]
_LEAK = 0.2


class TemporalUNet(nn.Module):
    """Ours: five units down, five up, over time, with skips between those of the same length."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...], kernel: int):
        super().__init__()
        self.first = nn.Conv1d(inputs, widths[0], kernel, padding=kernel // 2)
        ups = list(zip(widths[1:], widths[:-1], strict=True))
        self.down = nn.ModuleList(_ResidualUnit(width, kernel) for width in widths)
        self.wider = nn.ModuleList(nn.Conv1d(narrow, wide, 1) for wide, narrow in ups)
        self.bottom = _ResidualUnit(widths[-1], kernel)
        self.lift = nn.ConvTranspose1d(widths[-1], widths[-1], 2, stride=2)
        self.narrower = nn.ModuleList(nn.ConvTranspose1d(wide, narrow, 2, stride=2) for wide, narrow in ups)
        self.up = nn.ModuleList(_ResidualUnit(width, kernel) for width in widths)
        self.last = nn.Conv1d(widths[0], outputs, 1)
        _initialise_zero(self.last)

    def forward(self, rows: Float[Tensor, "batch rows frames"]) -> Float[Tensor, "batch outputs frames"]:
        """Return changes of the rows, in their own units; 0 before training."""
        hidden, kept = self.first(rows), []
        for level, unit in enumerate(self.down):
            hidden = unit(hidden)
            kept.append(hidden)
            hidden = max_pool1d(hidden, 2, ceil_mode=True)
            if level < len(self.wider):
                hidden = self.wider[level](hidden)
        hidden = self.lift(self.bottom(hidden))
        for level in reversed(range(len(self.up))):
            hidden = self.up[level](hidden[..., : kept[level].shape[-1]] + kept[level])
            if level:
                hidden = self.narrower[level - 1](hidden)
        return self.last(hidden)


class _ResidualUnit(nn.Module):
    """Two convolutions over time, added to the input."""

    def __init__(self, width: int, kernel: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.one = nn.Conv1d(width, width, kernel, padding=kernel // 2)
        self.two = nn.Conv1d(width, width, kernel, padding=kernel // 2)
        _initialise_zero(self.two)

    def forward(self, hidden: Float[Tensor, "batch width frames"]) -> Float[Tensor, "batch width frames"]:
        # Over channels alone: a frame must not depend on how long the motion is.
        normal = self.norm(hidden.transpose(1, 2)).transpose(1, 2)
        return hidden + self.two(leaky_relu(self.one(normal), _LEAK))


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


def _initialise_zero(layer: nn.Module) -> None:
    """Initialise a layer so that its output is 0 until training."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)


PAPER_WIDTHS = (32, 64, 128, 256, 256)
"""Channels of each unit: of 240 frames are left 3 x 8 x 256 numbers (Kaufmann et al. 2020, section 3.2)."""


_JOINTS = CANONICAL.num_joints
_POSITION_ROWS, _REFERENCE_ROWS, _CONTACT_ROWS = 3 * _JOINTS, 3, 2
IMAGE_ROWS = _POSITION_ROWS + _REFERENCE_ROWS + _CONTACT_ROWS
"""Rows of an image: joint positions, the reference's velocities, contacts."""
_MASK_ROWS = _JOINTS + 1 + 2  # known, one, frames since and until any joint is known
_VELOCITY_UNIT, _HEADING_UNIT = 0.05, 0.05  # one unit of the reference's velocities: metres and radians a frame
_MAX_FRAMES_SINCE = 60  # frames beyond which it is all one how far a known frame is


@dataclass(frozen=True)
class InfillerConfig(NetworkConfig):
    """Shape of the network."""

    architecture: Architecture = "skips"
    """Architecture: `skips` is ours, which keeps what is known, `image` that of Kaufmann et al. 2020."""
    widths: Sizes = (128, 160, 192, 256, 256)
    """Channels of the units of `skips`; those of `image` are fixed."""
    kernel: Size = 3
    """Width of a convolution of `skips`, frames."""

    def __post_init__(self):
        if self.kernel % 2 == 0:
            raise RequestError(f"an infiller's kernel must be odd, got {self.kernel}")


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
        """Fill an image; ours keeps known positions to the bit, an autoencoder makes all anew (section 4.2)."""
        # Joints that are never known are shown at their mean.
        shown = torch.where(image.known.any(dim=1)[:, None, :, None], image.positions, self.mean)
        rows = self._rows(image, shown)
        if self.keeps_observed:
            # Which joints are known, and how many frames ago and ahead any is, as a share of those that matter.
            far = count_frames_to_observed(image.known.any(dim=-1)).clamp(max=_MAX_FRAMES_SINCE) / _MAX_FRAMES_SINCE
            masks = (image.known, torch.ones_like(far[..., :1]), far)  # frames, beside what a convolution pads
            rows = torch.cat([rows, *(each.to(rows) for each in masks)], dim=-1)
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=self.reduced_precision):
            out = self.net(rows.transpose(1, 2)).transpose(1, 2).to(rows.dtype)
        change, contacts = (
            out[..., :_POSITION_ROWS].unflatten(-1, (_JOINTS, 3)) * self.std,
            4 * out[..., -_CONTACT_ROWS:],
        )
        if not self.keeps_observed:
            return ProposedPositions(self.mean + change, contacts)
        return ProposedPositions(torch.where(image.known[..., None], image.positions, shown + change), contacts)

    def _rows(self, image: PositionImage, shown: Tensor) -> Float[Tensor, "batch frames rows"]:
        """Encode the image in about unit size; an autoencoder's unknown positions are 0, their mean (section 3.3)."""
        positions = (shown - self.mean) / self.std
        if not self.keeps_observed:
            positions = positions * image.known[..., None]
        step = torch.diff(image.ground, dim=1, prepend=image.ground[:, :1])
        step = rotations.rotate_ground(step, -image.heading) / _VELOCITY_UNIT
        turn = torch.diff(image.heading, dim=1, prepend=image.heading[:, :1])[..., None] / _HEADING_UNIT
        return torch.cat([positions.flatten(-2), step, turn, 2 * image.contacts - 1], dim=-1)


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
        contacts = (one.contacts + other.contacts.flip(-1)) / 2
        return ProposedPositions(
            torch.where(image.known[..., None] & self.network.keeps_observed, image.positions, positions), contacts
        )
