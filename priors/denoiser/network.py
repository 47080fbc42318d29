"""The denoiser: a network that proposes, for a noisy capture, the motion behind it and its contacts.

An amortised posterior: trained on pairs of clean and spoilt motion, it gives in one pass what the sliding-window MAP
then makes exact. Dilated residual convolutions over time, on what was seen, a smoothed version of it, what was not
seen, and the noise's sigmas. Where noise is nil what was seen is returned: the change fades with the sigma.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gelu

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.numerics import gaussian
from mapctl.recording import Capture, Cleaned, filled
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.config import NetworkConfig

_OTHERS = CANONICAL.num_joints - 1
_ANGLES = 2 + 3 * _OTHERS  # tilt and rotation vectors
_INPUTS = 2 * _ANGLES + 2 + 1 + 6 + 3 + 2 * (CANONICAL.num_joints + 1)
_OUTPUTS = _ANGLES + 1 + 3 + 2

_SMOOTH, _SLOW = 2.0, 6.0  # frames, sigma: of the proposal's start, and of the frame of reference
_FAINT, _FAINT_ROOT = 0.0044, 0.001  # radians and metres: noise that is as often true motion
# One unit of what is seen and of what is changed, about their spread: radians, metres, metres a frame.
_ANGLE, _PLACE, _PACE = 0.3, 0.02, 0.05
_HIPS = 0.85  # metres: height of the canonical skeleton's hips while it walks
_PIECE, _MARGIN = 512, 64  # frames cleaned at once, and beside them


@dataclass(frozen=True)
class DenoiserConfig(NetworkConfig):
    """Shape of the network."""

    width: int = 192
    """Channels."""
    kernel: int = 5
    """Frames that one convolution sees."""
    dilations: tuple[int, ...] = (1, 2, 4, 8, 1, 2, 4, 8)
    """Of each residual block."""

    def __post_init__(self):
        if self.width < 1 or self.kernel < 1 or self.kernel % 2 == 0 or min(self.dilations, default=0) < 1:
            raise RequestError(f"a denoiser needs a positive width, an odd kernel and positive dilations, got {self}")


class DenoiserNetwork(nn.Module):
    """A capture in, a proposal out. Untrained, it smooths."""

    def __init__(self, config: DenoiserConfig, *, bfloat16: bool = False):
        """With `bfloat16` the convolutions compute in it; what they are given and give back does not."""
        super().__init__()
        self.config, self.reduced = config, bfloat16
        self.first = nn.Conv1d(_INPUTS, config.width, config.kernel, padding=config.kernel // 2)
        self.blocks = nn.ModuleList(_Block(config.width, config.kernel, dilation) for dilation in config.dilations)
        self.last = nn.Linear(config.width, _OUTPUTS)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, capture: Capture) -> Cleaned:
        """The proposal; frames that were not seen at all included."""
        view = _View(capture)
        inputs = view.inputs().transpose(1, 2)
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=self.reduced):
            hidden = self.first(inputs)
            for block in self.blocks:
                hidden = block(hidden)
            change = self.last(hidden.transpose(1, 2))
        return view.changed(change.to(inputs.dtype))


class _Block(nn.Module):
    """Normalise over channels, see neighbouring frames, mix; added to what came in."""

    def __init__(self, width: int, kernel: int, dilation: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.along = nn.Conv1d(width, width, kernel, dilation=dilation, padding=dilation * (kernel // 2))
        self.across = nn.Conv1d(width, width, 1)
        for parameter in self.across.parameters():
            nn.init.zeros_(parameter)

    def forward(self, hidden: Float[Tensor, "batch width frames"]) -> Float[Tensor, "batch width frames"]:
        normal = self.norm(hidden.transpose(1, 2)).transpose(1, 2)
        return hidden + self.across(gelu(self.along(normal)))


class _View:
    """A capture as the network sees it: in the slow frame of the hips, where place and heading do not matter."""

    def __init__(self, capture: Capture):
        self.capture = capture
        sigma, sigma_root = capture.sigma, capture.sigma_root[:, None]
        # The share of a sight that noise explains; of what was not seen, all of it.
        noise = (sigma.square() / (sigma.square() + _FAINT**2))[:, None]
        self.doubt = torch.where(capture.seen, noise, 1.0)
        root = (sigma_root.square() / (sigma_root.square() + _FAINT_ROOT**2))[:, None]
        self.root_doubt = torch.where(capture.seen_root[..., None], root, 1.0)

        batch, frames = capture.root.shape[:2]
        angles = capture.joints.transpose(1, 2).flatten(0, 1)
        shown = filled(angles, capture.seen[..., 1:].transpose(1, 2).flatten(0, 1))
        joints = shown.unflatten(0, (batch, _OTHERS)).transpose(1, 2).flatten(2)
        self.angles = torch.cat([capture.tilt, joints], dim=-1)
        self.angle_doubt = torch.cat(
            [self.doubt[..., :1].expand(batch, frames, 2), self.doubt[..., 1:].repeat_interleave(3, dim=-1)], dim=-1
        )
        root = filled(capture.root, capture.seen_root)
        self.slow_heading = _smooth(capture.heading[..., None], _SLOW)[..., 0]
        self.slow_root = _smooth(root, _SLOW)
        self.turn = (capture.heading - self.slow_heading)[..., None]
        self.off = _turned(root - self.slow_root, -self.slow_heading)

    def inputs(self) -> Float[Tensor, "batch frames inputs"]:
        """Everything in units of about one."""
        capture = self.capture
        rate = _rate(self.slow_heading[..., None])
        way = _turned(_rate(self.slow_root), -self.slow_heading)
        level = torch.log(torch.cat([capture.sigma, 3 * capture.sigma_root[:, None]], dim=-1).clamp_min(0.001)) + 3
        known = torch.cat([capture.seen, capture.seen_root[..., None]], dim=-1)
        return torch.cat(
            [
                self.angles / _ANGLE,
                _smooth(self.angles, _SMOOTH) / _ANGLE,
                self.turn / _ANGLE,
                _smooth(self.turn, _SMOOTH) / _ANGLE,
                rate / _PACE,
                self.off / _PLACE,
                _smooth(self.off, _SMOOTH) / _PLACE,
                way[..., ::2] / _PACE,
                (self.slow_root[..., 1:2] - _HIPS) / _ANGLE,
                known.to(self.angles),
                level[:, None].expand(-1, capture.frames, -1),
            ],
            dim=-1,
        )

    def changed(self, change: Float[Tensor, "batch frames outputs"]) -> Cleaned:
        """What was seen, smoothed and changed as far as it is in doubt."""
        angles, turn, off, contacts = change.split([_ANGLES, 1, 3, 2], dim=-1)
        angles = self.angles + self.angle_doubt * (_smooth(self.angles, _SMOOTH) - self.angles + _ANGLE * angles)
        turn = self.turn + self.doubt[..., :1] * (_smooth(self.turn, _SMOOTH) - self.turn + _ANGLE * turn)
        off = self.off + self.root_doubt * (_smooth(self.off, _SMOOTH) - self.off + _PLACE * off)
        root = self.slow_root + _turned(off, self.slow_heading)
        return Cleaned(root, self.slow_heading + turn[..., 0], angles, contacts)


def _rate(values: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
    """Change since the frame before."""
    return torch.diff(values, dim=1, prepend=values[:, :1])


def _turned(vector: Float[Tensor, "batch frames 3"], angle: Float[Tensor, "batch frames"]) -> Tensor:
    """Vectors turned about +Y."""
    ground = rotations.rotate_ground(vector[..., ::2], angle)
    return torch.stack([ground[..., 0], vector[..., 1], ground[..., 1]], dim=-1)


def _smooth(values: Float[Tensor, "batch frames width"], sigma: float) -> Float[Tensor, "batch frames width"]:
    """Gaussian along the frames, its weights adding up to one at the ends too."""
    weight = gaussian.averaging(values.shape[1], sigma, values.dtype, values.device)
    return torch.einsum("ts,bsw->btw", weight, values)


@dataclass(frozen=True, eq=False)
class ConvDenoiser:
    """A trained denoiser (see mapctl.protocols.Denoiser)."""

    name: str
    """How it was asked for."""
    network: DenoiserNetwork
    """Weights."""
    card: checkpoints.Card
    """What they are."""

    def clean(self, capture: Capture) -> Cleaned:
        """The proposal for a capture of any length, piece by piece, each with a margin that it shares."""
        pieces = []
        for start in range(0, capture.frames, _PIECE):
            first, stop = max(0, start - _MARGIN), min(capture.frames, start + _PIECE + _MARGIN)
            with torch.no_grad():
                cleaned = self.network(capture.slice(first, stop))
            kept = slice(start - first, start - first + _PIECE)
            parts = cleaned.root, cleaned.heading, cleaned.angles, cleaned.contacts
            pieces.append([value[:, kept] for value in parts])
        root, heading, angles, contacts = (torch.cat(values, dim=1) for values in zip(*pieces, strict=True))
        # Each piece counts whole turns from its own beginning.
        return Cleaned(root, rotations.unwrap_angle(heading), angles, contacts)


def load(name: str) -> ConvDenoiser:
    """The bundled denoiser by name, or a trained one by its file or run folder; CheckpointError if there is none."""
    with checkpoints.opened(name, "denoiser") as (tensors, card):
        network = DenoiserNetwork(DenoiserConfig.of_card(card.config))
        network.load_state_dict(tensors)
    return ConvDenoiser(name, network.eval().requires_grad_(False), card)
