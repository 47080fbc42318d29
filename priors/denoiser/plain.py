"""The plain peer of the denoiser: attention over the frames of a piece, and nothing made for the job.

Layers of a transformer encoder as PyTorch has them, after Vaswani et al. 2017, on what was observed, which of it was,
and the noise's sigmas.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

LAYERS, HEADS = 4, 4
PIECE_FRAMES, MARGIN_FRAMES = 32, 16
"""Frames that are cleaned at once, and beside them: together those of the windows that it is trained on."""


class PlainLayers(nn.Module):
    """Inputs of each frame to as many numbers as the network is wide."""

    def __init__(self, inputs: int, width: int):
        """The width is a multiple of HEADS, and even."""
        super().__init__()
        self.first = nn.Linear(inputs, width)
        # Layers are made one by one: nn.TransformerEncoder would begin all of them with the same weights.
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(width, HEADS, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True)
            for _ in range(LAYERS)
        )
        self.norm = nn.LayerNorm(width)

    def forward(self, inputs: Float[Tensor, "batch frames inputs"]) -> Float[Tensor, "batch frames width"]:
        """Look at all frames from each."""
        hidden = self.first(inputs)
        hidden = hidden + _encode_frames(*hidden.shape[1:]).to(hidden)
        for layer in self.layers:
            hidden = layer(hidden)
        return self.norm(hidden)


def _encode_frames(frames: int, width: int) -> Float[Tensor, "frames width"]:
    """Tell frames by sines and cosines of their number."""
    rates = torch.exp(-math.log(10_000.0) * torch.arange(0, width, 2) / width)
    angles = torch.arange(frames)[:, None] * rates
    return torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)
