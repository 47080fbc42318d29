"""The denoiser: a network that proposes, for a noisy capture, the motion behind it and its contacts.

An amortised posterior: trained on pairs of clean and corrupted motion, it gives in one pass what the sliding-window MAP
then makes exact. Dilated residual convolutions over time, on observed values, a smoothed version of them, the
observation mask, and the noise's sigmas. Without noise the observed values are returned: the change fades with the
sigma.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gelu

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.numerics import gaussian
from mapctl.numerics.intervals import fill_missing
from mapctl.pose import BodyPose
from mapctl.recording import Capture, CaptureProposal
from mapctl.skeleton import CANONICAL
from priors import checkpoints
from priors.checkpoints import NetworkConfig, Size, Sizes

_NON_ROOT_JOINTS = CANONICAL.num_joints - 1
_ANGLE_CHANNELS = 2 + 3 * _NON_ROOT_JOINTS  # tilt and rotation vectors
_WORLD_CHANNELS = 2 * (6 + 3) * CANONICAL.num_joints  # world rotations and positions, observed and smoothed
_INPUT_CHANNELS = 2 * _ANGLE_CHANNELS + 2 + 1 + 6 + 3 + 2 * (CANONICAL.num_joints + 1) + _WORLD_CHANNELS
_OUTPUT_BLOCKS = (_ANGLE_CHANNELS, 1, 3, 2)  # angles, turn, position beside the slow one, contacts

_SMOOTHING_SIGMA, _REFERENCE_SIGMA = 2.0, 6.0  # frames, sigma: of the proposal's start, and of the frame of reference
_NEGLIGIBLE_SIGMA, _NEGLIGIBLE_SIGMA_ROOT = 0.0044, 0.001  # radians and metres: noise that is as often true motion
ANGLE_UNIT, POSITION_UNIT = 0.3, 0.02
"""One unit of inputs and of outputs, about their standard deviation: radians, metres."""
_VELOCITY_UNIT = 0.05  # metres a frame
_HIPS_HEIGHT = 0.85  # metres: height of the canonical skeleton's hips while it walks
_SPREAD_SHIFT = -3.5  # logarithm of the spread, radians or metres, that training begins with
_CHUNK_FRAMES, _MARGIN_FRAMES = 512, 64  # frames cleaned at once, and beside them


@dataclass(frozen=True)
class DenoiserConfig(NetworkConfig):
    """Shape of the network."""

    FIXED: ClassVar = {"plain": False, "sees_world": True}

    width: Size = 192
    """Channels of the hidden layers."""
    kernel: Size = 5
    """Frames that one convolution sees."""
    dilations: Sizes = (1, 2, 4, 8, 1, 2, 4, 8)
    """Dilation of each residual block, frames."""

    def __post_init__(self):
        if self.kernel % 2 == 0:
            raise RequestError(f"a denoiser's kernel must be odd, got {self.kernel}")


class DenoiserNetwork(nn.Module):
    """Capture in, proposal out; untrained, it smooths."""

    def __init__(self, config: DenoiserConfig, *, bfloat16: bool = False):
        """Compute convolutions in bfloat16 if so asked; what they are given and give back is not."""
        super().__init__()
        self.config, self.reduced_precision = config, bfloat16
        self.first = nn.Conv1d(_INPUT_CHANNELS, config.width, config.kernel, padding=config.kernel // 2)
        self.blocks = nn.ModuleList(
            _ResidualBlock(config.width, config.kernel, dilation) for dilation in config.dilations
        )
        self.last = nn.Linear(config.width, sum(_OUTPUT_BLOCKS))
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.spread = nn.Linear(config.width, 1 + CANONICAL.num_joints)
        nn.init.zeros_(self.spread.weight)
        nn.init.constant_(self.spread.bias, _SPREAD_SHIFT)

    def forward(self, capture: Capture) -> CaptureProposal:
        """Propose a motion, frames that were not observed at all included."""
        view = _CaptureView(capture)
        inputs = view.inputs()
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=self.reduced_precision):
            hidden = self.first(inputs.transpose(1, 2))
            for block in self.blocks:
                hidden = block(hidden)
            hidden = hidden.transpose(1, 2)
            change, spread = self.last(hidden).to(inputs.dtype), self.spread(hidden.detach()).to(inputs.dtype)
        pose, contacts = view.changed(change)
        return CaptureProposal(pose, contacts, spread)


class _ResidualBlock(nn.Module):
    """Normalise over channels, convolve neighbouring frames, mix; added to the input."""

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


class _CaptureView:
    """A capture as the network's input: in the slow frame of the hips, where position and heading do not matter."""

    def __init__(self, capture: Capture):
        self.capture = capture
        sigma, sigma_root = capture.sigma, capture.sigma_root[:, None]
        # The share of an observation that noise explains; 1 for what was not observed.
        noise = (sigma.square() / (sigma.square() + _NEGLIGIBLE_SIGMA**2))[:, None]
        self.noise_share = torch.where(capture.seen, noise, 1.0)
        root = (sigma_root.square() / (sigma_root.square() + _NEGLIGIBLE_SIGMA_ROOT**2))[:, None]
        self.root_noise_share = torch.where(capture.seen_root[..., None], root, 1.0)

        batch = len(capture.root)
        angles = capture.joints.transpose(1, 2).flatten(0, 1)
        shown = fill_missing(angles, capture.seen[..., 1:].transpose(1, 2).flatten(0, 1))
        joints = shown.unflatten(0, (batch, _NON_ROOT_JOINTS)).transpose(1, 2).flatten(2)
        self.angles = torch.cat([capture.tilt, joints], dim=-1)
        self.angle_noise = _spread_over_angles(noise)
        self.angle_noise_share = _spread_over_angles(self.noise_share)
        root = fill_missing(capture.root, capture.seen_root)
        self.slow_heading = _smooth(capture.heading[..., None], _REFERENCE_SIGMA)[..., 0]
        self.slow_root = _smooth(root, _REFERENCE_SIGMA)
        self.turn = (capture.heading - self.slow_heading)[..., None]
        self.off = rotations.rotate_about_y(root - self.slow_root, -self.slow_heading)

    def inputs(self) -> Float[Tensor, "batch frames inputs"]:
        """Encode the capture, and the same smoothed, in units of about one."""
        # How the slow frame of the hips turns and travels, and its height.
        rate = _difference_frames(self.slow_heading[..., None]) / _VELOCITY_UNIT
        step = rotations.rotate_about_y(_difference_frames(self.slow_root), -self.slow_heading)[..., ::2]
        height = (self.slow_root[..., 1:2] - _HIPS_HEIGHT) / ANGLE_UNIT
        # Flags of what was observed, and the sigmas of its noise.
        capture = self.capture
        level = torch.log(torch.cat([capture.sigma, 3 * capture.sigma_root[:, None]], dim=-1).clamp_min(0.001)) + 3
        known = torch.cat([capture.seen, capture.seen_root[..., None]], dim=-1)
        return torch.cat(
            [
                self.angles / ANGLE_UNIT,
                _smooth(self.angles, _SMOOTHING_SIGMA) / ANGLE_UNIT,
                self.turn / ANGLE_UNIT,
                _smooth(self.turn, _SMOOTHING_SIGMA) / ANGLE_UNIT,
                rate,
                self.off / POSITION_UNIT,
                _smooth(self.off, _SMOOTHING_SIGMA) / POSITION_UNIT,
                step / _VELOCITY_UNIT,
                height,
                known.to(self.angles),
                level[:, None].expand(-1, capture.frames, -1),
                *self._world(),
            ],
            dim=-1,
        )

    def _world(self) -> list[Float[Tensor, "batch frames inputs"]]:
        """Encode the world rotations and positions of all joints in the slow frame of the hips: noise of positions,
        which makes a joint's angles err against its parent's, is independent there, and feet that slide can be seen."""
        x, z = self.angles[..., :2].unbind(dim=-1)
        tilt = rotations.rotation_vector_to_matrix(torch.stack([x, torch.zeros_like(x), z], dim=-1))
        hips = rotations.to_matrix(rotations.about_y(self.turn[..., 0])) @ tilt
        others = rotations.rotation_vector_to_matrix(self.angles[..., 2:].unflatten(-1, (-1, 3)))
        matrices = torch.cat([hips[..., None, :, :], others], dim=-3)
        positions, world = kinematics.chain_matrices(CANONICAL.offsets.to(matrices), CANONICAL.parents, matrices)
        six, positions = rotations.to_six(world).flatten(-2), (positions + self.off[..., None, :]).flatten(-2)
        both = torch.cat([six, positions / ANGLE_UNIT], dim=-1)
        return [both, _smooth(both, _SMOOTHING_SIGMA)]

    def changed(self, change: Float[Tensor, "batch frames outputs"]) -> tuple[BodyPose, Tensor]:
        """Apply a change to the smoothed observation, as far as noise or gaps allow one."""
        angles, turn, off, contacts = change.split(_OUTPUT_BLOCKS, dim=-1)
        # What was not observed is on a straight line already: it is smoothed as far as what it lies between is noisy.
        smoother = _smooth(self.angles, _SMOOTHING_SIGMA) - self.angles
        angles = self.angles + self.angle_noise * smoother + self.angle_noise_share * ANGLE_UNIT * angles
        turn = self.turn + self.noise_share[..., :1] * (
            _smooth(self.turn, _SMOOTHING_SIGMA) - self.turn + ANGLE_UNIT * turn
        )
        off = self.off + self.root_noise_share * (_smooth(self.off, _SMOOTHING_SIGMA) - self.off + POSITION_UNIT * off)
        root = self.slow_root + rotations.rotate_about_y(off, self.slow_heading)
        packed = torch.cat([root, (self.slow_heading + turn[..., 0])[..., None], angles], dim=-1)
        return BodyPose.unpack(packed), contacts


def _spread_over_angles(joints: Float[Tensor, "batch frames joints"]) -> Float[Tensor, "batch frames angles"]:
    """Repeat values of joints for the two angles of the hips' tilt and the three of each other joint."""
    return torch.cat([joints[..., :1].expand(*joints.shape[:-1], 2), joints[..., 1:].repeat_interleave(3, -1)], dim=-1)


def _difference_frames(values: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames width"]:
    """Change since the frame before."""
    return torch.diff(values, dim=1, prepend=values[:, :1])


def _smooth(values: Float[Tensor, "batch frames width"], sigma: float) -> Float[Tensor, "batch frames width"]:
    """Smooth by a Gaussian along the frames, its weights summing to one at the ends too."""
    weight = gaussian.averaging_matrix(values.shape[1], sigma, values.dtype, values.device)
    return torch.einsum("ts,bsw->btw", weight, values)


@dataclass(frozen=True, eq=False, repr=False)
class ConvDenoiser(checkpoints.NetworkModel[DenoiserNetwork]):
    """A trained denoiser (see mapctl.protocols.Denoiser)."""

    kind, parts = "denoiser", (DenoiserNetwork, DenoiserConfig)

    def clean(self, capture: Capture) -> CaptureProposal:
        """Propose the motion of a capture of any length, piece by piece, each with a margin that it shares."""
        pieces, count, margin = [], _CHUNK_FRAMES, _MARGIN_FRAMES
        for start in range(0, capture.frames, count):
            first, stop = max(0, start - margin), min(capture.frames, start + count + margin)
            with torch.no_grad():
                cleaned = self.network(capture.slice(first, stop))
            kept = slice(start - first, start - first + count)
            values = (cleaned.pose.pack(), cleaned.contact_logits, cleaned.log_spread)
            pieces.append([value[:, kept] for value in values])
        packed, contacts, spread = (torch.cat(values, dim=1) for values in zip(*pieces, strict=True))
        pose = BodyPose.unpack(packed)
        # Each piece counts whole turns from its own beginning.
        return CaptureProposal(replace(pose, heading=rotations.unwrap_angle(pose.heading)), contacts, spread)
