"""The generator of local motion: poses of every frame from sparse keys (Zhou et al. 2020, section 3.5, table 5)."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from mapctl import joint_ranges, kinematics, rotations
from mapctl.errors import RequestError
from mapctl.inbetweening import PositionImage
from mapctl.joint_ranges import JointRanges
from mapctl.numerics.intervals import last_observed, next_observed
from mapctl.skeleton import CANONICAL, Skeleton
from priors.checkpoints import NetworkConfig
from priors.tweening.path import ResidualConv

_OTHERS = CANONICAL.num_joints - 1
ROOT_ROWS = 6
"""Numbers of the hips' rotation, which is free (Zhou et al. 2019)."""
POSE_ROWS = ROOT_ROWS + 3 * _OTHERS
"""Numbers of a pose: the hips' six, and three for each other joint."""


@dataclass(frozen=True, eq=False)
class ConstrainedPose:
    """Poses within the ranges of the joints."""

    local_matrix: Float[Tensor, "*batch joints 3 3"]
    """Local rotations; the hips' is that in whatever frame it was told."""
    places: Float[Tensor, "*batch joints 3"]
    """Joint positions from the hips, metres, in the same frame."""


class RangeConstrainedKinematics(nn.Module):
    """Numbers of any size in, rotations within their ranges and positions on rigid bones out. It has no weights."""

    axes: Tensor
    mid_matrix: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, ranges: JointRanges | None = None, skeleton: Skeleton = CANONICAL):
        """With the bundled ranges, if none are given, on the bones of a skeleton of canonical joints."""
        super().__init__()
        ranges = joint_ranges.load() if ranges is None else ranges
        self.skeleton = skeleton
        # They are the code's, not learnt: weights do not hold them, a card tells which they were.
        for name in ("axes", "mid_matrix", "low", "high"):
            values = getattr(ranges, name)
            values = values.float() if values.is_floating_point() else values
            self.register_buffer(name, values, persistent=False)

    def forward(self, rows: Float[Tensor, "*batch rows"]) -> ConstrainedPose:
        """Return the poses of rows of POSE_ROWS numbers: the hips' by Gram and Schmidt, angles by Eq. 3, matrices in
        each joint's order, and the forward kinematics that all use."""
        root, free = rows.split([ROOT_ROWS, 3 * _OTHERS], dim=-1)
        ranges = JointRanges(self.axes, self.mid_matrix, self.low, self.high)
        others = ranges.to_matrices(ranges.constrain(free.unflatten(-1, (_OTHERS, 3))))
        local = torch.cat([rotations.from_six(root)[..., None, :, :], others], dim=-3)
        return ConstrainedPose(local, kinematics.positions_from_matrices(self.skeleton, local))


_PLACE_ROWS = 3 * CANONICAL.num_joints
_STYLE_ROWS = 3 * (CANONICAL.num_joints - 1)
_TRAVEL_ROWS, _TIME_ROWS, _CONTACT_ROWS = 3, 2, 2
INPUT_ROWS = 2 * _PLACE_ROWS + _TRAVEL_ROWS + _TIME_ROWS + _CONTACT_ROWS
"""Rows of the dense input: nearest known coordinates and how far they are, the reference's velocities, time since and
until anything is known, contacts."""
MAX_KEY_FRAMES = 480
"""Frames at the prior's rate beyond which it is all one how far a key is: 16 s, about what a frame of the output
sees."""
_VELOCITY_UNIT, _HEADING_UNIT = 0.05, 0.05  # one unit of the reference's velocities: metres and radians a frame
_STAGES = 6
_STRIDE = 2**_STAGES
_DOWN_RATIOS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
_UP_RATIOS = ((1.4, 1.6), (2.2, 2.8), (3.6, 4.6), (5.8, 7.2), (8.8, 10.6), (12.6, 14.8))


@dataclass(frozen=True)
class GeneratorConfig(NetworkConfig):
    """Shape of the network."""

    FIXED: ClassVar = {"keys": "dense", "architecture": "two-stage"}

    widths: tuple[int, ...] = (96, 128, 192, 256, 288, 288)
    """Channels of the encoder's layers, each of which halves the frames."""
    up_widths: tuple[int, ...] = (288, 288, 256, 192, 128, 96)
    """Channels of the decoder's stages, each of which doubles them."""
    style: int = 128
    """Numbers of the vector that a motion's style becomes."""
    skips: bool = True
    """Whether the decoder's stages also see the style, and what the encoder was given at their rate, which the paper's
    do not."""

    def __post_init__(self):
        if len(self.widths) != _STAGES or len(self.up_widths) != _STAGES or min(*self.widths, *self.up_widths) < 1:
            raise RequestError(f"a generator needs {_STAGES} positive widths down and as many up, got {self}")
        if self.style < 1:
            raise RequestError(f"a generator needs a style of at least one number, got {self.style}")


PAPER = GeneratorConfig((384, 384, 512, 512, 768, 1024), (1024, 768, 768, 512, 512, 512), style=1024, skips=False)
"""Sizes of Zhou et al. 2020, table 5."""


@dataclass(frozen=True, eq=False)
class GeneratedPoses:
    """Poses that the generator proposes."""

    pose: ConstrainedPose
    """Rotations and places from the hips, seen along the reference's heading."""
    responses: tuple[Tensor, ...]
    """What its convolutions gave, for batch regularisation."""

    def turn_to_world(self, image: PositionImage) -> ConstrainedPose:
        """Turn the poses from along the reference of the image that they were made for to the world's axes."""
        quats = rotations.about_y(image.heading)
        hips = rotations.to_matrix(quats) @ self.pose.local_matrix[..., 0, :, :]
        local = torch.cat([hips[..., None, :, :], self.pose.local_matrix[..., 1:, :, :]], dim=-3)
        return ConstrainedPose(local, rotations.rotate_about_y(self.pose.places, image.heading[..., None]))


class StyleEncoder(nn.Module):
    """Poses of a motion in, in any number and order; one vector out: the motion DNA (Zhou et al. 2020, section
    3.5.1)."""

    def __init__(self, style: int):
        super().__init__()
        # The text has a linear layer behind the mean, which the last of these is as well.
        self.layers = nn.Sequential(
            nn.Conv1d(_STYLE_ROWS, style, 1),
            _Affine(style),
            nn.PReLU(style),
            nn.Conv1d(style, style, 1),
            _Affine(style),
        )

    def forward(self, places: Float[Tensor, "batch poses joints 3"]) -> Float[Tensor, "batch style"]:
        """Encode joint positions from the hips, metres, without the hips' rotation."""
        return self.layers(places[..., 1:, :].flatten(-2).transpose(1, 2)).mean(dim=-1)


class GeneratorNetwork(nn.Module):
    """Keys and a style in, poses of all frames out; it normalises inside."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: GeneratorConfig | None = None, *, bfloat16: bool = False):
        """Compute convolutions in bfloat16 if so asked; what they are given and give back is not."""
        super().__init__()
        self.config, self.reduced_precision = config or GeneratorConfig(), bfloat16
        self.register_buffer("mean", torch.zeros(CANONICAL.num_joints, 3))
        self.register_buffer("std", torch.ones(CANONICAL.num_joints, 3))
        widths, style = self.config.widths, self.config.style
        self.style = StyleEncoder(style)
        self.encoder = nn.ModuleList(
            ResidualConv(channels, kernel=4, stride=2, padding=1, ratio=ratio)
            for channels, ratio in zip(zip((INPUT_ROWS, *widths[:-1]), widths, strict=True), _DOWN_RATIOS, strict=True)
        )
        self.decoder = nn.ModuleList(_make_decoder(widths[-1] + style, self.config.up_widths))
        seen = reversed((INPUT_ROWS, *widths[:-1]))
        self.skips = nn.ModuleList(
            nn.Conv1d(ins, outs, 1) for ins, outs in zip(seen, self.config.up_widths, strict=True) if self.config.skips
        )
        # Through the middle alone a style has to pass what the keys dictate, and is soon left aside.
        self.styles = nn.ModuleList(nn.Linear(style, outs) for outs in self.config.up_widths if self.config.skips)
        # Without a PReLU, which would halve the angles on one side.
        self.last = nn.Conv1d(self.config.up_widths[-1], POSE_ROWS, 3, padding=1)
        self.kinematics = RangeConstrainedKinematics()
        # Hips upright and joints about the middle of their ranges, until training.
        nn.init.normal_(self.last.weight, std=0.1 / math.sqrt(3 * self.config.up_widths[-1]))
        middle = torch.zeros(POSE_ROWS)
        middle[:6] = rotations.to_six(torch.eye(3, device="cpu"))
        self.last.bias = nn.Parameter(middle)

    def forward(self, image: PositionImage, style: Float[Tensor, "batch style"]) -> GeneratedPoses:
        """Generate poses of every frame of an image, of any length; `style` is what the style encoder gives, or 0."""
        rows = self.encode_rows(image).transpose(1, 2)
        made, responses = self.generate(rows, style)
        return GeneratedPoses(self.kinematics(made.transpose(1, 2)), responses)

    def generate(
        self, rows: Float[Tensor, "batch rows frames"], style: Float[Tensor, "batch style"]
    ) -> tuple[Float[Tensor, "batch out_rows frames"], tuple[Tensor, ...]]:
        """Run the convolutions alone; also returns what each of the residual ones gave."""
        frames, hidden = rows.shape[-1], pad(rows, (0, -rows.shape[-1] % _STRIDE))
        responses: list[Tensor] = []
        with torch.autocast(rows.device.type, torch.bfloat16, enabled=self.reduced_precision):
            levels = []
            for layer in self.encoder:
                levels.append(hidden)
                hidden = layer(hidden, responses)
            hidden = torch.cat([hidden, style[..., None].expand(-1, -1, hidden.shape[-1]).to(hidden)], dim=1)
            hidden = self.decoder[0](hidden, responses)
            for stage in range(_STAGES):
                for layer in self.decoder[1 + 2 * stage : 3 + 2 * stage]:
                    hidden = layer(hidden, responses)
                if self.config.skips:
                    hidden = (hidden + self.skips[stage](levels[_STAGES - 1 - stage])) / math.sqrt(2)
                    hidden = hidden + self.styles[stage](style)[..., None]
        # Angles need more than the eight bits of bfloat16, or who stands trembles.
        return self.last(hidden.to(rows.dtype))[..., :frames], tuple(responses)

    def encode_rows(self, image: PositionImage) -> Float[Tensor, "batch frames rows"]:
        """Encode the dense input of section 3.5, seen from the reference, in about unit size."""
        copied, away = image.copy_nearest()
        told = torch.isfinite(away)
        places = torch.where(told, (copied - self.mean) / self.std, 0.0)
        distances, times = _scale_frames(away), _encode_times(image)
        step = torch.diff(image.ground, dim=1, prepend=image.ground[:, :1])
        step = rotations.rotate_ground(step, -image.heading) / _VELOCITY_UNIT
        turn = torch.diff(image.heading, dim=1, prepend=image.heading[:, :1])[..., None] / _HEADING_UNIT
        parts = [places.flatten(-2), distances.flatten(-2), step, turn, times]
        rows = torch.cat([*parts, 2 * image.contacts - 1], dim=-1)
        return rows * image.present[..., None].to(rows)


class _Affine(nn.Module):
    """A scale and a shift for each channel."""

    def __init__(self, channels: int):
        super().__init__()
        self.scale, self.shift = nn.Parameter(torch.ones(channels, 1)), nn.Parameter(torch.zeros(channels, 1))

    def forward(self, frames: Float[Tensor, "batch channels frames"]) -> Float[Tensor, "batch channels frames"]:
        return self.scale * frames + self.shift


def regularise_batch(responses: tuple[Tensor, ...]) -> Float[Tensor, ""]:
    """Sum over layers the squares of means and of log deviations of their channels over batch and frames, averaged over
    channels: instead of batch normalisation (Zhou et al. 2020, Eq. 9)."""
    total = torch.zeros(())
    for response in responses:
        channels = response.float().transpose(0, 1).flatten(1)
        deviation = channels.var(dim=1, unbiased=False).add(1e-8).sqrt()
        total = total + channels.mean(dim=1).square().mean() + deviation.log().square().mean()
    return total


def _make_decoder(inputs: int, widths: tuple[int, ...]) -> list[ResidualConv]:
    layers = [ResidualConv((inputs, widths[0]), kernel=1, padding=0, ratio=1.0)]
    before = widths[0]
    for width, (plain, doubling) in zip(widths, _UP_RATIOS, strict=True):
        layers.append(ResidualConv((before, width), kernel=3, padding=1, ratio=plain))
        doubled = ResidualConv((width, width), kernel=4, stride=2, padding=1, ratio=doubling, transposed=True)
        layers.append(doubled)
        before = width
    return layers


def _scale_frames(away: Tensor) -> Tensor:
    """Scale numbers of frames to 0..1, by their logarithm: near a key every frame counts."""
    return torch.log1p(away.clamp(max=MAX_KEY_FRAMES)) / math.log1p(MAX_KEY_FRAMES)


def _encode_times(image: PositionImage) -> Float[Tensor, "batch frames times"]:
    """Encode how many frames ago and ahead anything is known."""
    some = image.known_axes.flatten(2).any(dim=-1)
    frame = torch.arange(some.shape[1], device=some.device)
    never = ~some.any(dim=1, keepdim=True)
    ago, ahead = frame - last_observed(some), next_observed(some) - frame
    # Before the first known frame the last one is none, and the other way round.
    times = [torch.where(never | (each < 0), MAX_KEY_FRAMES, each).to(image.places) for each in (ago, ahead)]
    return _scale_frames(torch.stack(times, dim=-1))
