"""The tweener: long in-betweens from few keys (Zhou et al. 2020).

A convolutional generator computes rotations within the ranges of the joints from positions of keys, seen from a
reference that leads from key to key; the path predictor computes the root trajectory from how the body moves; keys are
then met exactly. A style conditions the generator: the mean encoding of poses of a motion (its DNA), or of the clips of
a class, whose vectors are in the card of the weights.
"""

import base64
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor, nn
from torch.nn.functional import pad

from mapctl import contacts, joint_ranges, kinematics, rotations
from mapctl.errors import CheckpointError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import GapQuery, PositionImage, Proposal
from mapctl.inbetweening.effector_targets import LooseKeys, lead_over_positions
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.inbetweening.query import GapSource
from mapctl.inbetweening.root_trajectory import TREMBLE_HZ, LocalMotion, lead_over_keys
from mapctl.inbetweening.whole_body import bend_limbs
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.numerics.intervals import count_frames_to_observed, true_intervals
from mapctl.numerics.smooth_offsets import interpolate_turns, smooth_between
from mapctl.protocols import Inbetweener, PathPredictor
from mapctl.skeleton import CANONICAL, TOE_JOINTS, TOE_REST_HEIGHT
from priors import checkpoints
from priors.checkpoints import Card, NetworkConfig, Size, Sizes
from priors.path import ConvPathPredictor, ResidualConv

_SAMPLES = 129  # of a curve, to tell how long it is
_SHORT, _WHOLE = 1.0, 2.0  # seconds: straight as long as the first, wholly curved from the second on
_SLOW, _WALKS = 0.3, 0.6  # metres a second from key to key, likewise
_ASIDE, _AHEAD = math.radians(90.0), math.radians(70.0)  # between a key's heading and the other key, likewise
_SWAYS, _TURNS = math.radians(10.0), math.radians(25.0)  # of that angle again: hips sway with every step
_REACH, _REACH_A_SECOND, _LONGEST_REACH = 0.8, 0.3, 2.0
"""Length of the tangents over the distance of the keys, at first and more by the second: the longer there is time, the
sharper is the turn for its distance. Chosen on captured walks: a turn of 90 degrees takes about 2 s."""


def bend_trajectory(
    trajectory: Float[Tensor, "batch frames 2"],
    facing: Float[Tensor, "batch frames"],
    *,
    placed: Bool[Tensor, "batch frames"],
    faced: Bool[Tensor, "batch frames"],
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Bend trajectories (x, z, metres) and headings (radians) that lead straight between known positions, and evenly
    between known headings. Between neighbouring frames of which both are known and that are more than a second apart,
    the trajectory becomes a cubic curve along both headings (Hermite) and the heading its tangent. It stays as it is at
    what is known, for a character that stands or walks on straight, and between keys of which one looks away from the
    other; in between it bends the more, the clearer it is.
    """
    row, start = (placed | faced).nonzero(as_tuple=True)
    whole, frames = (placed & faced)[row, start], torch.diff(start)
    long = (torch.diff(row) == 0) & (frames > _SHORT * PRIOR_FPS) & whole[:-1] & whole[1:]
    row, start, frames = row[:-1][long], start[:-1][long], frames[long]
    if not len(row):
        return trajectory, facing
    first, last, seconds = trajectory[row, start], trajectory[row, start + frames], frames / PRIOR_FPS
    chord = last - first
    length, towards = chord.norm(dim=-1), torch.atan2(chord[:, 0], chord[:, 1])
    turns = [rotations.wrap_angle(facing[row, at] - towards) for at in (start, start + frames)]
    aside = torch.stack(turns).abs().amax(dim=0)
    ahead = _ramp(aside, _SWAYS, _TURNS) * _ramp(aside, _ASIDE, _AHEAD)
    share = _ramp(seconds, _SHORT, _WHOLE) * _ramp(length / seconds, _SLOW, _WALKS) * ahead
    reach = length * (_REACH + _REACH_A_SECOND * frames / PRIOR_FPS).clamp(max=_LONGEST_REACH)
    along = [torch.stack([(towards + turn).sin(), (towards + turn).cos()], dim=-1) * reach[:, None] for turn in turns]
    curves = torch.stack([first, last, *along], dim=1)
    bent, turned = trajectory.clone(), facing.clone()
    for leg in (share > 0).nonzero()[:, 0].tolist():
        count, inside = int(frames[leg]), (int(row[leg]), slice(int(start[leg]) + 1, int(start[leg] + frames[leg])))
        position, slope = _walk_evenly(curves[leg], count)
        # Evenly turning headings are unwrapped, and a curve's begin where they do.
        off = torch.atan2(slope[:, 0], slope[:, 1]) - (towards[leg] + turns[0][leg])
        begun = facing[row[leg], start[leg]] + rotations.wrap_angle(off)
        bent[inside] += share[leg] * (position - trajectory[inside])
        turned[inside] += share[leg] * rotations.wrap_angle(begun - facing[inside])
    return bent, turned


def _walk_evenly(
    curve: Float[Tensor, "4 2"], count: int
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, "frames 2"]]:
    """Return the points between the ends of a cubic curve, given these and the tangents there, in so many even steps,
    and the slopes there."""
    first, last, leaving, arriving = curve.double().numpy()
    spline = CubicHermiteSpline((0, 1), (first, last), (leaving, arriving))
    parameter = np.linspace(0, 1, _SAMPLES)
    walked = np.r_[0.0, np.linalg.norm(np.diff(spline(parameter), axis=0), axis=1).cumsum()]
    even = np.interp(walked[-1] * np.arange(1, count) / count, walked, parameter)
    return torch.from_numpy(spline(even)).to(curve), torch.from_numpy(spline(even, 1)).to(curve)


def _ramp(value: Tensor, none: float, whole: float) -> Tensor:
    """Return 0 at `none`, 1 at `whole`, and linearly between."""
    return ((value - none) / (whole - none)).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class GivenParts:
    """Known parts of keys; a frame without any is no key."""

    axes: Bool[Tensor, "batch frames joints 3"]
    """Whether a coordinate of a joint is given, in the reference's axes. The hips' x and z are their ground position;
    coordinates of the others are seen from there, heights from the floor."""
    heading: Bool[Tensor, "batch frames"]
    """Whether the hips' heading is given."""
    view: Float[Tensor, " batch"]
    """Heading of a reference that does not turn, radians, for what is drawn from one side; NaN where it leads from key
    to key."""

    @staticmethod
    def whole(known: Bool[Tensor, "batch frames"]) -> "GivenParts":
        """Tell the whole poses of some frames."""
        axes = known[..., None, None].expand(*known.shape, CANONICAL.num_joints, 3)
        return GivenParts(axes, known, torch.full((len(known),), torch.nan))

    @property
    def known(self) -> Bool[Tensor, "batch frames"]:
        """Frames in which anything is given."""
        return self.axes.flatten(2).any(dim=-1)

    @property
    def placed(self) -> Bool[Tensor, "batch frames"]:
        """Frames in which the hips' ground position is given."""
        return self.axes[..., 0, 0] & self.axes[..., 0, 2]


def make_key_image(motion: PartialMotion, given: GivenParts) -> PositionImage:
    """Return the image of the given parts of some frames; the rest of the motion may hold anything finite."""
    positions = motion.world_poses()[0]
    ground, heading = lead_reference(motion.root_position[..., ::2], motion.heading, given)
    shift = rotations.lift_ground(ground - motion.root_position[..., ::2])
    return PositionImage.of_world(
        positions + shift[:, :, None],
        heading,
        see_contacts(motion.contacts, given.known),
        known=given.axes.all(dim=-1),
        known_axes=given.axes,
    )


def lead_reference(
    ground: Float[Tensor, "batch frames 2"], heading: Float[Tensor, "batch frames"], given: GivenParts
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Lead the reference (ground, metres; heading, radians) from each given position and heading to the next: along a
    walked trajectory (`bend_trajectory`) where that is clear, else straight and evenly. Without any given heading it
    faces along its trajectory."""
    # A drawing stands where its hips are, also if only one axis of these is given.
    shown = given.axes[..., 0, :].any(dim=-1)
    trajectory, facing = lead_over_positions(ground, heading, placed=shown, faced=given.heading)
    drawn = torch.isfinite(given.view)[:, None]
    trajectory, facing = bend_trajectory(trajectory, facing, placed=shown, faced=given.heading & ~drawn)
    return trajectory, torch.where(drawn, torch.nan_to_num(given.view)[:, None], facing)


def see_contacts(
    contacts: Float[Tensor, "batch frames 2"], known: Bool[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames 2"]:
    """Forget contacts, as 0.5, where no frame beside is known: a single pose does not tell whether its toes move."""
    off = torch.zeros_like(known[:, :1])
    beside = torch.cat([off, known[:, :-1]], dim=1) | torch.cat([known[:, 1:], off], dim=1)
    return torch.where((known & beside)[..., None], contacts, 0.5)


_OTHERS = CANONICAL.num_joints - 1
ROOT_ROWS = 6
"""Numbers of the hips' rotation, which is free (Zhou et al. 2019)."""
POSE_ROWS = ROOT_ROWS + 3 * _OTHERS
"""Numbers of a pose: the hips' six, and three for each other joint."""


@dataclass(frozen=True, eq=False)
class ConstrainedPose:
    """Poses within the ranges of the joints."""

    local_matrix: Float[Tensor, "*batch joints 3 3"]  # local rotations; the hips' is in the frame in which it was given
    positions: Float[Tensor, "*batch joints 3"]  # joint positions from the hips, metres, in the same frame


def constrain_poses(rows: Float[Tensor, "*batch rows"]) -> ConstrainedPose:
    """Return the poses of rows of POSE_ROWS numbers of any size: the hips' rotation by Gram and Schmidt, angles by
    Eq. 3, matrices in each joint's order, and positions by the forward kinematics that all use."""
    root, free = rows.split([ROOT_ROWS, 3 * _OTHERS], dim=-1)
    ranges = joint_ranges.load()
    others = ranges.to_matrices(ranges.constrain(free.unflatten(-1, (_OTHERS, 3))))
    local = torch.cat([rotations.from_six(root)[..., None, :, :], others], dim=-3)
    return ConstrainedPose(local, kinematics.positions_from_matrices(CANONICAL, local))


_POSITION_ROWS = 3 * CANONICAL.num_joints
_STYLE_ROWS = 3 * (CANONICAL.num_joints - 1)
_TRAVEL_ROWS, _TIME_ROWS, _CONTACT_ROWS = 3, 2, 2
INPUT_ROWS = 2 * _POSITION_ROWS + _TRAVEL_ROWS + _TIME_ROWS + _CONTACT_ROWS
"""Rows of the dense input: nearest known coordinates and how far they are, the reference's velocities, time since and
until anything is known, contacts."""
MAX_KEY_FRAMES = 480
"""Frames at the prior's rate beyond which it is all one how far a key is: 16 s, about what an output frame sees."""
_VELOCITY_UNIT, _HEADING_UNIT = 0.05, 0.05  # one unit of the reference's velocities: metres and radians a frame
_STAGES = 6
_STRIDE = 2**_STAGES
_DOWN_RATIOS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
_UP_RATIOS = ((1.4, 1.6), (2.2, 2.8), (3.6, 4.6), (5.8, 7.2), (8.8, 10.6), (12.6, 14.8))


@dataclass(frozen=True)
class GeneratorConfig(NetworkConfig):
    """Shape of the network."""

    FIXED: ClassVar = {"keys": "dense", "architecture": "two-stage"}

    widths: Sizes = (96, 128, 192, 256, 288, 288)
    """Channels of the encoder's layers, each of which halves the frames."""
    up_widths: Sizes = (288, 288, 256, 192, 128, 96)
    """Channels of the decoder's stages, each of which doubles them."""
    style: Size = 128
    """Numbers of the vector that a motion's style becomes."""
    skips: bool = True
    """Whether the decoder's stages also see the style, and what the encoder was given at their rate, which the paper's
    do not."""

    def __post_init__(self):
        if len(self.widths) != _STAGES or len(self.up_widths) != _STAGES:
            raise RequestError(f"a generator needs {_STAGES} widths down and as many up, got {self}")


PAPER = GeneratorConfig((384, 384, 512, 512, 768, 1024), (1024, 768, 768, 512, 512, 512), style=1024, skips=False)
"""Sizes of Zhou et al. 2020, table 5."""


@dataclass(frozen=True, eq=False)
class GeneratedPoses:
    """Poses that the generator proposes."""

    pose: ConstrainedPose  # rotations and positions from the hips, seen along the reference's heading
    responses: tuple[Tensor, ...]  # outputs of its convolutions, for batch regularisation

    def turn_to_world(self, image: PositionImage) -> ConstrainedPose:
        """Turn the poses from along the reference of their image to the world's axes."""
        quats = rotations.about_y(image.heading)
        hips = rotations.to_matrix(quats) @ self.pose.local_matrix[..., 0, :, :]
        local = torch.cat([hips[..., None, :, :], self.pose.local_matrix[..., 1:, :, :]], dim=-3)
        return ConstrainedPose(local, rotations.rotate_about_y(self.pose.positions, image.heading[..., None]))


class StyleEncoder(nn.Module):
    """Poses of a motion in, in any number and order; one vector out: the motion DNA (Zhou et al. 2020, 3.5.1)."""

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

    def forward(self, positions: Float[Tensor, "batch poses joints 3"]) -> Float[Tensor, "batch style"]:
        """Encode joint positions from the hips, metres, without the hips' rotation."""
        return self.layers(positions[..., 1:, :].flatten(-2).transpose(1, 2)).mean(dim=-1)


class GeneratorNetwork(nn.Module):
    """Keys and a style in, poses of all frames out; it normalises inside."""

    mean: Tensor
    std: Tensor

    def __init__(self, config: GeneratorConfig, *, bfloat16: bool = False):
        """Compute convolutions in bfloat16 if so asked; what they are given and give back is not."""
        super().__init__()
        self.config, self.reduced_precision = config, bfloat16
        self.register_buffer("mean", torch.zeros(CANONICAL.num_joints, 3))
        self.register_buffer("std", torch.ones(CANONICAL.num_joints, 3))
        widths, style = config.widths, config.style
        self.style = StyleEncoder(style)
        self.encoder = nn.ModuleList(
            ResidualConv(channels, kernel=4, stride=2, padding=1, ratio=ratio)
            for channels, ratio in zip(zip((INPUT_ROWS, *widths[:-1]), widths, strict=True), _DOWN_RATIOS, strict=True)
        )
        self.decoder = nn.ModuleList(_make_decoder(widths[-1] + style, config.up_widths))
        seen = reversed((INPUT_ROWS, *widths[:-1]))
        self.skips = nn.ModuleList(
            nn.Conv1d(ins, outs, 1) for ins, outs in zip(seen, config.up_widths, strict=True) if config.skips
        )
        # Through the middle alone a style has to pass what the keys dictate, and is soon left aside.
        self.styles = nn.ModuleList(nn.Linear(style, outs) for outs in config.up_widths if config.skips)
        # Without a PReLU, which would halve the angles on one side.
        self.last = nn.Conv1d(config.up_widths[-1], POSE_ROWS, 3, padding=1)
        # Hips upright and joints about the middle of their ranges, until training.
        nn.init.normal_(self.last.weight, std=0.1 / math.sqrt(3 * config.up_widths[-1]))
        middle = torch.zeros(POSE_ROWS)
        middle[:6] = rotations.to_six(torch.eye(3, device="cpu"))
        self.last.bias = nn.Parameter(middle)

    def forward(self, image: PositionImage, style: Float[Tensor, "batch style"]) -> GeneratedPoses:
        """Generate poses of every frame of an image, of any length; `style` is what the style encoder gives, or 0."""
        rows = self.encode_rows(image).transpose(1, 2)
        generated, responses = self.generate(rows, style)
        return GeneratedPoses(constrain_poses(generated.transpose(1, 2)), responses)

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
        # Angles need more than the eight bits of bfloat16, or a standing character trembles.
        return self.last(hidden.to(rows.dtype))[..., :frames], tuple(responses)

    def encode_rows(self, image: PositionImage) -> Float[Tensor, "batch frames rows"]:
        """Encode the dense input of section 3.5, seen from the reference, in about unit size."""
        copied, away = image.copy_nearest()
        given = torch.isfinite(away)
        positions = torch.where(given, (copied - self.mean) / self.std, 0.0)
        some = image.known_axes.flatten(2).any(dim=-1)
        distances, times = _scale_frames(away), _scale_frames(count_frames_to_observed(some))
        step = torch.diff(image.ground, dim=1, prepend=image.ground[:, :1])
        step = rotations.rotate_ground(step, -image.heading) / _VELOCITY_UNIT
        turn = torch.diff(image.heading, dim=1, prepend=image.heading[:, :1])[..., None] / _HEADING_UNIT
        parts = [positions.flatten(-2), distances.flatten(-2), step, turn, times]
        return torch.cat([*parts, 2 * image.contacts - 1], dim=-1)


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


LABELS = r"^.*dataset-\d+_([^_/]+)_[^/]*$|^(?:.*/)?([^/]+/[^/]+)/[^/]+$|^([^/]+)/[^/]+$|^(.*?)[\d_ -]*\.[^.]*$"
"""Classes of clips by their names, unless another pattern is given: what Bandai Namco call the content; for others the
folder, two deep; without folders the file's name less its number."""
_FIELD = "classes"  # of a card's data


@dataclass(frozen=True, eq=False)
class Style:
    """How to move."""

    name: str
    """Its source, for notes: files or classes."""
    vector: Float[Tensor, " style"]
    """Its encoding by the style encoder."""
    poses: Float[Tensor, "poses joints 3"] | None = None
    """Poses of it, as `mapctl.motion_dna` takes them; None for a class."""


def mix_styles(styles: Sequence[Style]) -> Style:
    """Mix styles, each as much as the others; RequestError for none."""
    if not styles:
        raise RequestError("a style needs at least one clip or class")
    poses = [style.poses for style in styles if style.poses is not None]
    return Style(
        " and ".join(style.name for style in styles),
        torch.stack([style.vector for style in styles]).mean(dim=0),
        torch.cat(poses) if poses else None,
    )


def draw_style(
    styles: Sequence[Style],
    number: int,
    encode: Callable[[Float[Tensor, "poses joints 3"], str], Style],
    *,
    order: Sequence[int],
    generator: torch.Generator,
) -> Style:
    """Draw the style of the variation of this number: the styles one after the other in this order, and then again some
    poses of each, drawn anew, or a class mixed with another. RequestError for one class alone, which leaves no choice.
    """
    base = styles[order[number % len(styles)]]
    if number < len(styles) and len(styles) > 1:
        return base
    if base.poses is not None:
        count = max(1, len(base.poses) // 2)
        chosen = torch.randperm(len(base.poses), generator=generator)[:count]
        return encode(base.poses[chosen], f"{base.name}, {count} of its poses")
    others = [style for style in styles if style is not base]
    if not others:
        raise RequestError(f"the class {base.name} alone leaves nothing to vary; name more classes or motion files")
    other = others[int(torch.randint(len(others), (), generator=generator))]
    share = 0.3 + 0.4 * float(torch.rand((), generator=generator))
    return Style(f"{base.name} and {other.name}", torch.lerp(base.vector, other.vector, share), other.poses)


def find_class(clip: str, labels: str = LABELS) -> str | None:
    """Find the class of a clip by its name: what the first group of the pattern that took part matched, folders joined
    by a hyphen; None where the pattern is not found. RequestError for a pattern without a group, or that is none."""
    try:
        pattern = re.compile(labels)
    except re.error as error:
        raise RequestError(f"--labels must be a regular expression, got {labels!r} ({error})") from error
    if not pattern.groups:
        raise RequestError(f"--labels needs a group as in _([a-z-]+)_, which is the class; got {labels!r}")
    found = pattern.search(clip)
    given = next((group for group in found.groups() if group), "") if found else ""
    return given.replace("/", "-") or None


@torch.no_grad()
def encode_classes(
    encoder: StyleEncoder, classes: Mapping[str, Sequence[Float[Tensor, "poses joints 3"]]]
) -> dict[str, Any]:
    """Encode classes for the data of a card: by name the number of clips, and the mean of their vectors."""
    encoded = {}
    for name in sorted(classes):
        each = torch.stack([encoder(dna[None])[0] for dna in classes[name]])
        half = each.mean(dim=0).numpy().astype("<f2")
        encoded[name] = {"clips": len(each), "vector": base64.b64encode(half.tobytes()).decode("ascii")}
    return {_FIELD: encoded}


def read_classes(card: Card, size: int) -> dict[str, Style]:
    """Read the classes of a card by name, none of an older one; CheckpointError where they are not of this size."""
    styles = {}
    for name, given in card.data.get(_FIELD, {}).items():
        try:
            vector = np.frombuffer(base64.b64decode(given["vector"], validate=True), "<f2").astype(np.float32)
        except ValueError as error:
            raise CheckpointError(f"the class {name} in the card holds no vector ({error})") from error
        if len(vector) != size or not np.isfinite(vector).all():
            raise CheckpointError(f"the class {name} in the card must hold {size} finite numbers, got {len(vector)}")
        styles[name] = Style(name, torch.from_numpy(vector))
    return styles


def count_clips(data: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the classes in a card's data by the number of clips of each, for people to read."""
    if _FIELD not in data:
        return dict(data)
    return {**data, _FIELD: {name: given["clips"] for name, given in data[_FIELD].items()}}


def pick_class(classes: Mapping[str, Style], name: str) -> Style:
    """Pick a class; RequestError, naming the nearest, for one that there is not."""
    if name in classes:
        return classes[name]
    if not classes:
        raise RequestError(f"there is no file {name}, and these weights know no classes of motion")
    near = get_close_matches(name, classes, n=1, cutoff=0.0)[0]
    raise RequestError(
        f"there is no file and no class {name}; the nearest class is {near} (`mapctl info tweener` lists all)"
    )


def show_loose_keys(image: PositionImage, loose: LooseKeys) -> PositionImage:
    """Show ground positions, over which the reference of an image of one motion leads, and drawings in frames of
    which nothing else is known: from where the first of these is seen the reference then looks back, without turning.
    """
    axes, positions = image.known_axes.clone(), image.positions
    axes[0, loose.placed, 0, 0] = axes[0, loose.placed, 0, 2] = True
    seen = loose.see_from_one_side(CANONICAL)
    if seen is None:
        return replace(image, known_axes=axes)
    turned = replace(image, heading=torch.full_like(image.heading, seen.view))
    positions = turned.from_world(image.to_world(positions))
    open_frames = ~image.known[0].any(dim=-1) & loose.drawings
    shown = seen.known & open_frames[:, None, None]
    axes[0] |= shown
    positions = torch.where(shown, seen.positions.to(positions), positions[0])[None]
    return replace(turned, positions=positions, known_axes=axes)


PART_FRAMES = MAX_KEY_FRAMES // 2
"""Frames of the longest part of a gap that is split."""


def find_splits(query: GapQuery) -> dict[range, list[int]]:
    """Find the gaps in which nothing is known and that are longer than the network sees, and frames at which poses
    split each, evenly from edge to edge."""
    gaps = [range(start, stop) for _, start, stop in true_intervals(query.nothing_known[:, None])]
    parts = {gap: -(-len(gap) // PART_FRAMES) for gap in gaps if len(gap) > MAX_KEY_FRAMES}
    return {gap: [gap.start + round(k * len(gap) / count) for k in range(1, count)] for gap, count in parts.items()}


def show_edges(query: GapQuery, split: range) -> Float[Tensor, "poses joints 3"]:
    """Return the whole poses next to a gap, the one after it first, as motion DNA has them: metres from the hips,
    without the hips' rotation, of unit size. None where no pose is whole."""
    whole = (~query.missing.frames).nonzero()[:, 0]
    after, before = whole[whole >= split.stop], whole[whole < split.start]
    beside = torch.cat([after[:1], before[-1:]])
    upright = query.motion.local_quat_xyzw[beside].clone()
    upright[:, 0] = upright.new_tensor([0.0, 0.0, 0.0, 1.0])
    return kinematics.positions_from_matrices(CANONICAL, rotations.to_matrix(upright)).float()


def place_poses(
    poses: Float[Tensor, "poses joints 3"], body: Motion, frames: Sequence[int]
) -> Float[Tensor, "frames joints 3"]:
    """Place poses in these frames of a body that is led from key to key, turned to its heading there, the lower
    toe on the floor; spread over all of them, or one after the other and all over again if there are fewer. Metres,
    world."""
    count, there_are = len(frames), len(poses)
    picked = [one * there_are // count if count < there_are else one % there_are for one in range(count)]
    chosen = poses[picked].double()
    facing = heading(body.local_quat_xyzw[frames, 0])
    turned = rotations.rotate_about_y(chosen, facing[:, None])
    ground = body.root_position[frames] * torch.tensor([1.0, 0.0, 1.0]).double()
    lift = TOE_REST_HEIGHT - turned[:, list(TOE_JOINTS), 1].amin(dim=1)
    return turned + ground[:, None] + lift[:, None, None] * torch.tensor([0.0, 1.0, 0.0]).double()


SOURCE = "tweener"
"""Name of the in-betweener in notes."""
_MARGIN = 4
"""Frames that the network also answers for before the first frame and after the last: where its convolutions end, its
poses jump, and keys stand there."""
_FLICKER_HZ, _FLICKER_SHARE = 14.0, 0.5
"""Frequency of which half is taken from generated rotations, and how far they follow: faster than 8 Hz they change more
than mocap's, and slower less."""
_KEY_SECONDS = 0.5  # over which what a key was missed by fades away from it


@dataclass(frozen=True, eq=False, repr=False)
class Tweener(checkpoints.NetworkModel[GeneratorNetwork], Inbetweener):
    """A trained generator of long in-betweens with the path predictor that it was trained with."""

    kind = "tweener"

    path: PathPredictor
    """Predictor of the root trajectory."""
    style: Style | None = field(default=None)
    """How to move; None leaves it to the keys."""
    classes: Mapping[str, Style] = field(default_factory=dict)
    """Styles that the weights know by name."""

    @classmethod
    def load(cls, name: str, path: str = "path") -> "Tweener":
        """Load the bundled tweener, or a trained one by its file or run folder, with the path predictor that it was
        trained with; CheckpointError for anything else, and for another path predictor."""
        with checkpoints.open_checkpoint(name, cls.kind) as (tensors, card):
            network = checkpoints.build_network(GeneratorNetwork, GeneratorConfig.of_card(card.config), tensors)
        classes = read_classes(card, network.config.style)
        wanted, found = card.data.get("path"), checkpoints.compute_hash(path)
        if wanted != found:
            raise CheckpointError(
                f"{name} was trained with the path predictor {str(wanted)[:12]}; {path} is {found}: name it by --path"
            )
        return Tweener(name, network, card, ConvPathPredictor.load(path), classes=classes)

    @property
    def has_style(self) -> bool:
        """Whether a style conditions it."""
        return self.style is not None

    @property
    def source(self) -> str:
        """Its name in notes."""
        return SOURCE if self.style is None else f"{SOURCE} in the style of {self.style.name}"

    def styled(self, dna: Float[Tensor, "poses joints 3"]) -> "Tweener":
        """Return the in-betweener that moves as a motion of which these are poses."""
        return self.in_style(self.encode_style(dna))

    def in_style(self, style: Style) -> "Tweener":
        """Return the in-betweener that moves in a style: one of `classes`, or the result of `encode_style`."""
        return replace(self, style=style)

    @torch.no_grad()
    def encode_style(self, dna: Float[Tensor, "poses joints 3"], name: str = "motion DNA") -> Style:
        """Encode poses of a motion as a style of this name."""
        return Style(name, self.network.style(dna[None])[0], dna)

    @torch.no_grad()
    def propose(self, query: GapQuery, *, generator: torch.Generator | None = None) -> Proposal:
        """Propose poses of the whole motion at once, and lead the hips by them, without sampling.

        Errors at keys are removed by the smoothest offsets of joints' rotations; the trajectory's error at a known
        position is spread in proportion to the distance walked; hips do not tremble, and legs bend so that feet which
        stand stay there. Effector targets are ignored. Gaps that are longer than the network sees are split by poses of
        the style, or of the keys beside them.
        """
        shown, missing, splits = query.motion, query.missing, find_splits(query)
        given = self._choose_poses(query, splits)
        generated, origin = self._make(query, given)
        met = interpolate_turns(generated, shown.local_quat_xyzw, ~missing.joints, seconds=_KEY_SECONDS, fps=PRIOR_FPS)
        quats = torch.where(missing.joints[..., None], met, shown.local_quat_xyzw)
        body = query.to_unit_size(replace(shown, local_quat_xyzw=rotations.make_sign_continuous(quats)))
        body, logits = self._lead(body, query, origin)
        motion = query.to_character(body)
        root = torch.where(missing.root[:, None], motion.root_position, shown.root_position)
        motion = replace(motion, root_position=root)
        known = query.known_positions[:, list(TOE_JOINTS)]
        planted = contacts.to_logits(contacts.detect_contacts(body.joint_positions()[:, list(TOE_JOINTS)], PRIOR_FPS))
        return Proposal(
            motion, torch.where(known, planted, logits), self.source, tuple(self._describe_splits(query, splits, given))
        )

    def _make(
        self, query: GapQuery, given: Mapping[int, Float[Tensor, "joints 3"]]
    ) -> tuple[Float[Tensor, "frames joints 4"], Float[Tensor, " 3"]]:
        """Make rotations of all frames, near what is known and near poses that are given by frame, metres, world; also
        return the origin that these are seen from."""
        image, origin = _show(query, given)
        style = torch.zeros(self.network.config.style) if self.style is None else self.style.vector
        wide = image.extended(_MARGIN)
        generated, inside = self.network(wide, style[None]), slice(_MARGIN, -_MARGIN)
        local = generated.turn_to_world(wide).local_matrix[0, inside]
        return calm_poses(rotations.from_matrix(local.double())), origin

    def _choose_poses(
        self, query: GapQuery, splits: Mapping[range, Sequence[int]]
    ) -> dict[int, Float[Tensor, "joints 3"]]:
        """Choose the poses that split gaps, by frame, at their positions in a motion of unit size, metres, world."""
        given = {}
        for split, frames in splits.items():
            own = None if self.style is None else self.style.poses
            poses = show_edges(query, split) if own is None else own
            if len(poses):
                given |= dict(zip(frames, place_poses(poses, _walk_over(query), frames), strict=True))
        return given

    def _describe_splits(
        self, query: GapQuery, splits: Mapping[range, Sequence[int]], given: Mapping[int, Float[Tensor, "joints 3"]]
    ) -> Iterator[GapSource]:
        """Tell which gaps are too long for the network, and when which poses split them."""
        by = "the keys beside it" if self.style is None or self.style.poses is None else "the style"
        for split, frames in splits.items():
            times = ", ".join(f"{float(query.seconds[frame]):.1f}" for frame in frames if frame in given)
            reason = f"longer than the {MAX_KEY_FRAMES / PRIOR_FPS:.0f} s that the {SOURCE} sees; "
            reason += f"split at {times} s by poses of {by}" if times else "give more keys"
            yield GapSource(split.start, split.stop, self.source, reason)

    def _walk(self, body: Motion) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames 2"]]:
        """Lead the hips by how the body moves, from the origin on, metres at unit size; also the contacts' logits."""
        facing = heading(body.local_quat_xyzw[:, 0])
        still = replace(body, root_position=torch.zeros_like(body.root_position))
        seen = still.joint_positions().float()[None]
        predicted = self.path.predict(LocalMotion.of_world(seen, facing.float()[None]))
        return predicted.integrate(facing.float()[None])[0].double(), predicted.contacts[0]

    def _lead(
        self, body: Motion, query: GapQuery, origin: Float[Tensor, " 3"]
    ) -> tuple[Motion, Float[Tensor, "frames 2"]]:
        """Lead the hips by how the body moves, from known position to known position; also return contacts' logits."""
        trajectory, logits = self._walk(body)
        loose = None if query.loose is None else query.loose.scaled(1 / query.scale)
        if loose is not None:
            loose = replace(loose, ground=loose.ground - origin[::2])
        led = lead_over_keys(trajectory, body.root_position - origin, query.missing.root, loose)
        given = ~query.missing.root if loose is None else ~query.missing.root | loose.placed
        calm = smooth_between(led, given, hertz=TREMBLE_HZ, fps=PRIOR_FPS) + origin
        if query.keep_trajectory:
            calm = torch.cat([body.root_position[:, :1], calm[:, 1:2], body.root_position[:, 2:]], dim=-1)
            return replace(body, root_position=calm), logits
        generated = replace(body, root_position=calm)
        share = torch.sigmoid(logits).double()
        return keep_feet(generated, led + origin - calm, share, query), logits


def _show(query: GapQuery, given: Mapping[int, Float[Tensor, "joints 3"]]) -> tuple[PositionImage, Float[Tensor, " 3"]]:
    """Return the query and poses given by frame as the network takes them, of unit size, and where its origin is."""
    # Joints are given in the world, or about hips of whose whole body the ground position alone is missing.
    body, known = _walk_over(query), query.known_positions | ~query.missing.joints.any(dim=1, keepdim=True)
    placed = known[:, 0].nonzero()[:, 0]
    origin = body.root_position[placed[0] if len(placed) else 0] * torch.tensor([1.0, 0.0, 1.0]).double()
    positions = body.joint_positions()
    planted = contacts.detect_contacts(positions[:, list(TOE_JOINTS)], PRIOR_FPS).float()
    if given:
        positions, known = positions.clone(), known.clone()
        positions[list(given)], known[list(given)] = torch.stack(list(given.values())), True
    image = PositionImage.of_world(
        (positions - origin).float()[None],
        heading(body.local_quat_xyzw[:, 0]).float()[None],
        see_contacts(planted[None], known.any(dim=1)[None]),
        known=known[None],
    )
    return (image if query.loose is None else show_loose_keys(image, query.loose)), origin


def calm_poses(quats: Float[Tensor, "frames joints 4"]) -> Float[Tensor, "frames joints 4"]:
    """Leave less of the fastest changes of rotations, which the network makes more of than performers do."""
    even = rotations.make_sign_continuous(quats)
    free = torch.zeros(len(even), dtype=torch.bool)
    calm = smooth_between(even.flatten(1), free, hertz=_FLICKER_HZ, fps=PRIOR_FPS).unflatten(1, even.shape[1:])
    return torch.nn.functional.normalize(torch.lerp(even, calm, _FLICKER_SHARE), dim=-1)


def _walk_over(query: GapQuery) -> Motion:
    """Return the query's motion at unit size, whose hips go through gaps along `bend_trajectory`."""
    motion = query.to_unit_size(query.motion)
    facing = rotations.unwrap_angle(heading(motion.local_quat_xyzw[:, 0]))
    placed, faced = ~query.missing.root[None], ~query.missing.joints[None, :, 0]
    trajectory, turned = bend_trajectory(motion.root_position[None, :, ::2], facing[None], placed=placed, faced=faced)
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    root[:, ::2] = trajectory[0]
    bent = turned[0] != facing
    quats[bent, 0] = rotations.multiply(rotations.about_y((turned[0] - facing)[bent]), quats[bent, 0])
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def keep_feet(
    body: Motion, away: Float[Tensor, "frames 3"], planted: Float[Tensor, "frames 2"], query: GapQuery
) -> Motion:
    """Bend the legs of a body whose hips were moved so far from where planted feet want them, until these are where
    they were; `planted` from 0 to 1."""
    ends = body.joint_positions().clone()
    for foot, toe in enumerate(TOE_JOINTS):
        ends[:, CANONICAL.parents[toe]] += planted[:, foot, None] * away
    wanted = torch.zeros(ends.shape[:2], dtype=torch.bool)
    return bend_limbs(body, body, ends, wanted, query.missing.joints)
