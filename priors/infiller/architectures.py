"""Networks that fill position images: that of Kaufmann et al. 2020, and ours.

Both are given an image as rows over time, and return the rows of the whole motion. That of Kaufmann et al. 2020,
section 3.2, treats them as a picture, with filters over rows and frames, and makes the motion anew. Ours has five
encoding and five decoding units, but its filters run over time alone and see all rows at once; it is given the mask of
known joints, keeps these, changes linear interpolation in the gaps, and passes details across by skips.
"""

from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, max_pool1d, max_pool2d

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
        _initialise_glorot(self)

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


def _initialise_glorot(network: nn.Module) -> None:
    """Initialise weights as Glorot and Bengio 2010, biases 0 (Kaufmann et al. 2020, section 3.3)."""
    for parameter in network.parameters():
        if parameter.dim() > 1:
            nn.init.xavier_uniform_(parameter)
        else:
            nn.init.zeros_(parameter)


PAPER_WIDTHS = (32, 64, 128, 256, 256)
"""Channels of each unit, so that a sample of 240 frames becomes its 3 x 8 x 256 (Kaufmann et al. 2020, section
3.2)."""
