"""The path predictor: a convolutional network that predicts the hips' trajectory from the body's motion (Zhou et al.
2020, section 3.4 and table 5).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool1d, pad

from mapctl.inbetweening.root_trajectory import LocalMotion, RootTrajectory
from mapctl.protocols import PathPredictor
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Size


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


_JOINTS = CANONICAL.num_joints - 1  # all but the hips, from which the others are seen
_POSITION_ROWS = 3 * _JOINTS
_ROWS = 2 * _POSITION_ROWS + 2
_ANCHORS = tuple(CANONICAL.index(side + part) for side in ("left", "right") for part in ("Foot", "Toes"))
_OUT_ROWS = 2 + 1 + 2 + len(_ANCHORS) + 1
_STEP_UNIT, _TURN_UNIT, _VELOCITY_UNIT = 0.01, 0.05, 0.03  # metres, radians and metres a frame
_HEIGHT_UNIT = 0.03  # metres
_CONTACT_UNIT = 4.0  # of a logit
_STRIDE = 16  # frames of the input to one of the innermost layers


@dataclass(frozen=True)
class PathConfig(NetworkConfig):
    """Shape of the network."""

    width: Size = 64
    """Channels of the outer layers, 128 in the paper; the inner ones have twice as many."""


class PathNetwork(nn.Module):
    """A body seen from its hips in, steps, height and contacts out; it normalises inside."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: PathConfig, *, bfloat16: bool = False):
        """Compute convolutions in bfloat16 if so asked; what they are given and give back is not."""
        super().__init__()
        self.config, self.reduced_precision = config, bfloat16
        self.register_buffer("mean", torch.zeros(_JOINTS, 3))
        self.register_buffer("std", torch.ones(_JOINTS, 3))
        outer, inner = config.width, 2 * config.width
        down = ((_ROWS, outer), (outer, outer), (outer, inner), (inner, inner))
        up = ((inner, inner), (inner, inner), (inner, outer), (outer, outer))
        self.layers = nn.Sequential(
            *(
                ResidualConv(channels, kernel=12, stride=2, padding=5, ratio=ratio)
                for ratio, channels in enumerate(down, start=1)
            ),
            *(
                ResidualConv(channels, kernel=8, stride=2, padding=3, ratio=ratio, transposed=True)
                for ratio, channels in enumerate(up, start=5)
            ),
        )
        # The paper's last layer is residual as the others; its PReLU would treat steps back otherwise than ahead.
        self.last = nn.Conv1d(outer, _OUT_ROWS, 5, padding=2)

    def forward(self, motion: LocalMotion) -> RootTrajectory:
        """Predict the trajectory; 123 to 138 frames on either side are seen."""
        frames = motion.turns.shape[1]
        rows = pad(self._rows(motion).transpose(1, 2), (0, -frames % _STRIDE))
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=self.reduced_precision):
            out = self.last(self.layers(rows))
        out = out[..., :frames].transpose(1, 2).to(rows.dtype)
        steps, height, contacts, shares = out.split([2, 1, 2, len(_ANCHORS) + 1], dim=-1)
        return RootTrajectory(
            _mix_anchored_steps(motion, shares) + _STEP_UNIT * steps,
            # Of hips whose lower toe stands.
            TOE_REST_HEIGHT - motion.positions[..., list(TOE_JOINTS), 1].amin(dim=-1) + _HEIGHT_UNIT * height[..., 0],
            _CONTACT_UNIT * contacts,
        )

    def _rows(self, motion: LocalMotion) -> Float[Tensor, "batch frames rows"]:
        """Encode the body in about unit size: positions and how they change, heading change, and where frames are.

        The change is a difference of two positions that a convolution can take, but in the positions' own unit it would
        be lost: millimetres beside decimetres.
        """
        scaled = ((motion.positions[..., 1:, :] - self.mean) / self.std).flatten(-2)
        steps = motion.anchored_steps()[..., 1:, :].flatten(-2) / _VELOCITY_UNIT
        turns = motion.turns[..., None] / _TURN_UNIT
        return torch.cat([scaled, steps, turns, torch.ones_like(turns)], dim=-1)


def _mix_anchored_steps(motion: LocalMotion, shares: Float[Tensor, "batch frames shares"]) -> Tensor:
    """Mix the steps that would keep each foot and toe in its place, and none, by logits.

    A standing character so stays still to the millimetre, whatever the weights.
    """
    steps = motion.anchored_steps()[..., list(_ANCHORS), ::2]
    return (torch.softmax(shares, dim=-1)[..., :-1, None] * steps).sum(dim=-2)


@dataclass(frozen=True, eq=False, repr=False)
class ConvPathPredictor(checkpoints.NetworkModel[PathNetwork], PathPredictor):
    """A trained path predictor."""

    kind, parts = "path", (PathNetwork, PathConfig)

    @torch.no_grad()
    def predict(self, motion: LocalMotion) -> RootTrajectory:
        """Predict the trajectory of motions of any length: the mean of the outputs for them and their mirror images."""
        one, other = self.network(motion), self.network(motion.mirrored()).mirrored()
        return RootTrajectory(
            (one.steps_heading + other.steps_heading) / 2,
            (one.height + other.height) / 2,
            (one.contacts + other.contacts) / 2,
        )
