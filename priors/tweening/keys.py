"""What the generator is told: poses or parts of them at keys, seen from a reference that leads from key to key.

The way between two keys that who walks forwards would take: it leaves the first along its heading, comes to the next
along that one's, and turns in between.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl import rotations
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening import PositionImage
from mapctl.inbetweening.effector_targets import lead_over_places
from mapctl.inbetweening.partial_motion import PartialMotion
from mapctl.kinematics import heading
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_JOINTS

_SAMPLES = 129  # of a curve, to tell how long it is
_SHORT, _WHOLE = 1.0, 2.0  # seconds: straight as long as the first, wholly curved from the second on
_SLOW, _WALKS = 0.3, 0.6  # metres a second from key to key, likewise
_ASIDE, _AHEAD = math.radians(90.0), math.radians(70.0)  # between a key's heading and the other key, likewise
_SWAYS, _TURNS = math.radians(10.0), math.radians(25.0)  # of that angle again: hips sway with every step
_REACH, _REACH_A_SECOND, _LONGEST_REACH = 0.8, 0.3, 2.0
"""Length of the tangents over the distance of the keys, at first and more by the second: the longer there is time, the
sharper is the turn for its way. Chosen on captured walks: a turn of 90 degrees takes about 2 s."""


@dataclass(frozen=True, eq=False)
class _Legs:
    """Ways from key to key, one a row."""

    row: Int[Tensor, " legs"]
    """Sequence that each is of."""
    start: Int[Tensor, " legs"]
    """Frame of its first key."""
    frames: Int[Tensor, " legs"]
    """Frames from there to the next."""


def bend_way(
    way: Float[Tensor, "batch frames 2"],
    facing: Float[Tensor, "batch frames"],
    *,
    placed: Bool[Tensor, "batch frames"],
    faced: Bool[Tensor, "batch frames"],
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Bend a way (x, z, metres) and headings (radians) that lead straight between frames in which a place is told, and
    evenly between frames in which a heading is. Between neighbours that tell both, and that who walks forwards at an
    even pace would take more than a second for, the way becomes a cubic curve along both headings (Hermite) and the
    heading its tangent. It stays as it is at what is told, for who stands or walks on straight, and between keys of
    which one looks away from the other; in between it bends the more, the clearer it is.
    """
    legs = _find_legs(placed, faced)
    if not len(legs.row):
        return way, facing
    ends = legs.start + legs.frames
    first, last = way[legs.row, legs.start], way[legs.row, ends]
    chord = last - first
    length = chord.norm(dim=-1)
    towards = torch.atan2(chord[:, 0], chord[:, 1])
    turns = [rotations.wrap_angle(facing[legs.row, at] - towards) for at in (legs.start, ends)]
    share = _choose_share(legs, length, torch.stack(turns).abs().amax(dim=0))
    reach = length * (_REACH + _REACH_A_SECOND * legs.frames / PRIOR_FPS).clamp(max=_LONGEST_REACH)
    tangents = [_point(towards + turn) * reach[:, None] for turn in turns]
    return _follow(way, facing, legs, share, (first, last, *tangents), towards + turns[0])


def bend_motion(motion: Motion, *, placed: Bool[Tensor, " frames"], faced: Bool[Tensor, " frames"]) -> Motion:
    """Bend the hips' way and turn the body along it, in frames of a motion at PRIOR_FPS and of unit size between those
    whose hips have a known place and heading."""
    facing = rotations.unwrap_angle(heading(motion.local_quat_xyzw[:, 0]))
    way, turned = bend_way(motion.root_position[None, :, ::2], facing[None], placed=placed[None], faced=faced[None])
    root, quats = motion.root_position.clone(), motion.local_quat_xyzw.clone()
    root[:, ::2] = way[0]
    bent = turned[0] != facing
    quats[bent, 0] = rotations.multiply(rotations.about_y((turned[0] - facing)[bent]), quats[bent, 0])
    return replace(motion, root_position=root, local_quat_xyzw=quats)


def _find_legs(placed: Tensor, faced: Tensor) -> _Legs:
    """Find frames that tell a place and a heading with more than _SHORT until the next that tells anything, and that
    both as well."""
    row, frame = (placed | faced).nonzero(as_tuple=True)
    whole, frames = (placed & faced)[row, frame], torch.diff(frame)
    long = (torch.diff(row) == 0) & (frames > _SHORT * PRIOR_FPS) & whole[:-1] & whole[1:]
    return _Legs(row[:-1][long], frame[:-1][long], frames[long])


def _choose_share(legs: _Legs, length: Tensor, aside: Tensor) -> Float[Tensor, " legs"]:
    seconds = legs.frames / PRIOR_FPS
    ahead = _ramp(aside, _SWAYS, _TURNS) * _ramp(aside, _ASIDE, _AHEAD)
    return _ramp(seconds, _SHORT, _WHOLE) * _ramp(length / seconds, _SLOW, _WALKS) * ahead


def _follow(
    way: Tensor,
    facing: Tensor,
    legs: _Legs,
    share: Float[Tensor, " legs"],
    curve: tuple[Tensor, ...],
    begins: Float[Tensor, " legs"],
) -> tuple[Tensor, Tensor]:
    """Follow the curves evenly, as far as each one's share; the curves begin at these headings."""
    bent, turned = way.clone(), facing.clone()
    parameters = torch.linspace(0, 1, _SAMPLES).to(way)
    steps = torch.diff(_place(curve, parameters.expand(len(share), -1)), dim=1).norm(dim=-1)
    walked = torch.nn.functional.pad(steps.cumsum(dim=1), (1, 0))
    for leg in (share > 0).nonzero()[:, 0].tolist():
        row, start, count = int(legs.row[leg]), int(legs.start[leg]), int(legs.frames[leg])
        inside = slice(start + 1, start + count)
        wanted = walked[leg, -1] * torch.arange(1, count).to(way) / count
        parameter = _invert(walked[leg], wanted)
        own = tuple(each[leg : leg + 1] for each in curve)
        place, along = (each(own, parameter[None])[0] for each in (_place, _differentiate))
        # Evenly turning headings are unwrapped, and a curve's begin where they do.
        begun = facing[row, start] + rotations.wrap_angle(torch.atan2(along[:, 0], along[:, 1]) - begins[leg])
        bent[row, inside] += share[leg] * (place - way[row, inside])
        turned[row, inside] += share[leg] * rotations.wrap_angle(begun - facing[row, inside])
    return bent, turned


def _invert(walked: Float[Tensor, " samples"], wanted: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Return the curve's parameters after so many metres."""
    after = torch.searchsorted(walked, wanted).clamp(1, _SAMPLES - 1)
    before, step = walked[after - 1], walked[after] - walked[after - 1]
    return (after - 1 + (wanted - before) / step.clamp_min(1e-9)) / (_SAMPLES - 1)


def _place(curve: tuple[Tensor, ...], parameter: Float[Tensor, "legs points"]) -> Float[Tensor, "legs points 2"]:
    u = parameter[..., None]
    weights = (2 * u**3 - 3 * u**2 + 1, 3 * u**2 - 2 * u**3, u**3 - 2 * u**2 + u, u**3 - u**2)
    return sum((weight * each[:, None] for weight, each in zip(weights, curve, strict=True)), torch.zeros_like(u))


def _differentiate(curve: tuple[Tensor, ...], parameter: Float[Tensor, "legs points"]) -> Tensor:
    u = parameter[..., None]
    weights = (6 * u**2 - 6 * u, 6 * u - 6 * u**2, 3 * u**2 - 4 * u + 1, 3 * u**2 - 2 * u)
    return sum((weight * each[:, None] for weight, each in zip(weights, curve, strict=True)), torch.zeros_like(u))


def _point(heading: Float[Tensor, " legs"]) -> Float[Tensor, "legs 2"]:
    return torch.stack([heading.sin(), heading.cos()], dim=-1)


def _ramp(value: Tensor, none: float, whole: float) -> Tensor:
    """Return 0 at `none`, 1 at `whole`, and linearly between."""
    return ((value - none) / (whole - none)).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class ToldParts:
    """What keys tell; a frame that tells nothing is none."""

    axes: Bool[Tensor, "batch frames joints 3"]
    """Which coordinates of joints are told, in the reference's axes. Of the hips x and z are their place on the ground;
    coordinates of the others are seen from there, heights from the floor."""
    heading: Bool[Tensor, "batch frames"]
    """Whether the hips' heading is told."""
    view: Float[Tensor, " batch"]
    """Heading of a reference that does not turn, radians, for what is drawn from one side; NaN where it leads from key
    to key."""

    @staticmethod
    def whole(known: Bool[Tensor, "batch frames"]) -> "ToldParts":
        """Tell the whole poses of some frames."""
        axes = known[..., None, None].expand(*known.shape, CANONICAL.num_joints, 3)
        return ToldParts(axes, known, torch.full((len(known),), torch.nan))

    @property
    def known(self) -> Bool[Tensor, "batch frames"]:
        """Frames in which anything is told."""
        return self.axes.flatten(2).any(dim=-1)

    @property
    def placed(self) -> Bool[Tensor, "batch frames"]:
        """Frames in which the hips' place on the ground is told."""
        return self.axes[..., 0, 0] & self.axes[..., 0, 2]


def make_key_image(motion: PartialMotion, told: ToldParts) -> PositionImage:
    """Make the image of what is told of some frames; the rest of the motion may hold anything finite."""
    places = motion.world_poses()[0]
    ground, heading = lead_reference(motion.root_position[..., ::2], motion.heading, told)
    shift = rotations.lift_ground(ground - motion.root_position[..., ::2])
    return PositionImage.of_world(
        places + shift[:, :, None],
        heading,
        see_contacts(motion.contacts, told.known),
        known=told.axes.all(dim=-1),
        present=torch.ones_like(told.heading),
        toes=TOE_JOINTS,
        known_axes=told.axes,
    )


def lead_reference(
    ground: Float[Tensor, "batch frames 2"], heading: Float[Tensor, "batch frames"], told: ToldParts
) -> tuple[Float[Tensor, "batch frames 2"], Float[Tensor, "batch frames"]]:
    """Lead the reference (ground, metres; heading, radians) from told place to told place, and from told heading to
    told heading: as who walks would (`bend_way`) where that is clear, else straight and evenly. Where a sequence tells
    no heading, it looks along its way."""
    # What is drawn stands where its hips are, also if only one axis of these is told.
    shown = told.axes[..., 0, :].any(dim=-1)
    way, facing = lead_over_places(ground, heading, placed=shown, faced=told.heading)
    drawn = torch.isfinite(told.view)[:, None]
    way, facing = bend_way(way, facing, placed=shown, faced=told.heading & ~drawn)
    return way, torch.where(drawn, torch.nan_to_num(told.view)[:, None], facing)


def see_contacts(
    contacts: Float[Tensor, "batch frames 2"], known: Bool[Tensor, "batch frames"]
) -> Float[Tensor, "batch frames 2"]:
    """Forget contacts, as 0.5, where no frame beside is known: a single pose does not tell whether its toes move."""
    off = torch.zeros_like(known[:, :1])
    beside = torch.cat([off, known[:, :-1]], dim=1) | torch.cat([known[:, 1:], off], dim=1)
    return torch.where((known & beside)[..., None], contacts, 0.5)
