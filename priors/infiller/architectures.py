"""Networks that fill position images: those of Kaufmann et al. 2020, its baselines, and ours.

All are given an image as rows over time, and give the rows of the whole motion. That of Kaufmann et al. 2020, section
3.2, treats them as a picture, with filters over rows and frames, and makes the motion anew. Ours has the same five
encoding and five decoding units, but its filters run over time alone and see all rows at once; it is given the mask of
known joints, keeps these, changes linear interpolation in the gaps, and passes details across by skips. The recurrent
one is in `transitions.py`.
"""

from collections.abc import Callable
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, max_pool1d, max_pool2d, relu

Architecture = Literal["skips", "image", "vanilla", "manifold", "recurrent"]
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
    """The autoencoder of Kaufmann et al. 2020: 3x3 filters over rows and frames, pooling, strided de-convolutions; or
    its vanilla baseline, with a single strided convolution in each unit."""

    def __init__(self, widths: tuple[int, ...], *, vanilla: bool):
        super().__init__()
        self.vanilla = vanilla
        ins = (1, *widths[:-1])
        stride = 2 if vanilla else 1
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, 3, padding=1, stride=stride) for a, b in zip(ins, widths, strict=True)
        )
        self.down_two = nn.ModuleList() if vanilla else nn.ModuleList(nn.Conv2d(b, b, 3, padding=1) for b in widths)
        outs = tuple(reversed(ins))
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(b, b if not vanilla else a, 2, stride=2)
            for b, a in zip(reversed(widths), outs, strict=True)
        )
        self.up_two = (
            nn.ModuleList()
            if vanilla
            else nn.ModuleList(nn.Conv2d(b, a, 3, padding=1) for b, a in zip(reversed(widths), outs, strict=True))
        )
        _initialise_glorot(self)

    def forward(self, rows: Float[Tensor, "batch rows frames"]) -> Float[Tensor, "batch rows frames"]:
        """Return the rows anew."""
        hidden, sizes = rows[:, None], []
        for level, layer in enumerate(self.down):
            sizes.append(hidden.shape[-2:])
            hidden = leaky_relu(layer(hidden), _LEAK)
            if not self.vanilla:
                hidden = max_pool2d(leaky_relu(self.down_two[level](hidden), _LEAK), 2, ceil_mode=True)
        for level, (layer, size) in enumerate(zip(self.up, reversed(sizes), strict=True)):
            last = level == len(self.up) - 1
            hidden = layer(hidden)[..., : size[0], : size[1]]
            if not self.vanilla:
                hidden = self.up_two[level](leaky_relu(hidden, _LEAK))
            hidden = hidden if last else leaky_relu(hidden, _LEAK)
        return hidden[:, 0]


class HoldenManifold(nn.Module):
    """One layer over time, the motion manifold of Holden et al. 2016 (second baseline of Kaufmann et al. 2020)."""

    def __init__(self, rows: int, width: int = 256, kernel: int = 25):
        super().__init__()
        self.encode = nn.Conv1d(rows, width, kernel, padding=kernel // 2)
        self.decode = nn.Conv1d(width, rows, kernel, padding=kernel // 2)
        _initialise_glorot(self)

    def forward(self, rows: Float[Tensor, "batch rows frames"]) -> Float[Tensor, "batch rows frames"]:
        """Return the rows anew."""
        hidden = max_pool1d(relu(self.encode(rows)), 2, ceil_mode=True)
        return self.decode(hidden.repeat_interleave(2, dim=-1)[..., : rows.shape[-1]])


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

AUTOENCODERS: dict[str, Callable[[int], nn.Module]] = {
    "image": lambda rows: ImageAutoencoder(PAPER_WIDTHS, vanilla=False),
    "vanilla": lambda rows: ImageAutoencoder(PAPER_WIDTHS, vanilla=True),
    "manifold": HoldenManifold,
}
"""Networks that make all rows anew, by name: from the number of rows."""
