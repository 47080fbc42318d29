"""Residual convolutions over frames that keep the variance of what they are given (Zhou et al. 2020, Eq. 6)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool1d


class ResidualConv(nn.Module):
    """A convolution whose residual is mixed with its input: sqrt(s) PReLU(affine(conv(x))) + sqrt(1 - s) x, with s the
    inverse of `ratio`.

    The paper's Eq. 6 prints the shortcut twice; it is added once here, so that residual and shortcut of unit variance
    make a sum of unit variance. Where lengths differ the shortcut is averaged or repeated, where channels differ it is
    a linear map; the paper gives neither.
    """

    def __init__(
        self,
        channels: tuple[int, int],
        *,
        kernel: int,
        stride: int = 1,
        padding: int,
        ratio: float,
        transposed: bool = False,
    ):
        """From so many channels to so many; `transposed` lengthens by the stride instead of shortening."""
        super().__init__()
        ins, outs = channels
        make = nn.ConvTranspose1d if transposed else nn.Conv1d
        self.conv = make(ins, outs, kernel, stride=stride, padding=padding)
        self.scale, self.shift = nn.Parameter(torch.ones(outs, 1)), nn.Parameter(torch.zeros(outs, 1))
        self.activation = nn.PReLU(outs)
        self.stride, self.transposed, self.share = stride, transposed, 1 / ratio
        across = nn.Identity() if ins == outs else nn.Conv1d(ins, outs, 1, bias=False)
        self.across = across if ratio > 1 else None
        # An output frame of a transposed convolution is reached by every stride-th tap alone.
        _initialise(self.conv, ins * kernel // (stride if transposed else 1))
        if isinstance(self.across, nn.Conv1d):
            _initialise(self.across, ins)

    def forward(
        self, frames: Float[Tensor, "batch channels frames"], responses: list[Tensor] | None = None
    ) -> Float[Tensor, "batch outs out_frames"]:
        """Return the mix of residual and shortcut; what the convolution alone gives, which batch regularisation looks
        at (Eq. 9), is added to `responses`."""
        response = self.conv(frames)
        if responses is not None:
            responses.append(response)
        residual = self.activation(self.scale * response + self.shift)
        if self.across is None:
            return residual
        shortcut = self.across(self._resample(frames))
        return math.sqrt(self.share) * residual + math.sqrt(1 - self.share) * shortcut

    def _resample(self, frames: Float[Tensor, "batch channels frames"]) -> Tensor:
        if self.stride == 1:
            return frames
        if self.transposed:
            return frames.repeat_interleave(self.stride, dim=-1)
        return avg_pool1d(frames, self.stride)


def _initialise(conv: nn.Conv1d | nn.ConvTranspose1d, taps: int) -> None:
    """Draw weights that keep unit variance, given how many inputs meet in an output."""
    nn.init.normal_(conv.weight, std=1 / math.sqrt(taps))
    if conv.bias is not None:
        nn.init.zeros_(conv.bias)
