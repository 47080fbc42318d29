"""A body as rounded segments between joints: what hands may touch, and where on it a point is."""

from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.skeleton import CANONICAL, Skeleton, leg_length

# From joint, to joint, half widths at both ends in metres for the canonical body: of the trunk along x and z, of limbs
# all around. The head ends at a point of its own.
_TRUNK = (
    ("hips", "spine", (0.135, 0.095), (0.125, 0.090)),
    ("spine", "chest", (0.125, 0.090), (0.135, 0.098)),
    ("chest", "neck", (0.135, 0.098), (0.075, 0.060)),
    ("neck", "head", (0.050, 0.050), (0.050, 0.050)),
    ("head", "", (0.078, 0.095), (0.078, 0.095)),
)
_LIMBS = (
    ("Shoulder", "UpperArm", 0.055, 0.055),
    ("UpperLeg", "LowerLeg", 0.080, 0.057),
    ("LowerLeg", "Foot", 0.050, 0.036),
    ("Foot", "Toes", 0.040, 0.035),
)
_ARMS = (("UpperArm", "LowerArm", 0.046, 0.040), ("LowerArm", "Hand", 0.037, 0.028))
_HEAD_TIP = (0.0, 0.12, 0.0)  # metres from the head joint to the middle of the skull's top, of the canonical body
_END_SHARE = 0.15  # of a segment, before its ends, over which points stop being beside it
_SIDES = ("left", "right")


@dataclass(frozen=True, eq=False)
class Layout:
    """Which segments a body has."""

    start: tuple[int, ...]
    """Canonical joint at which each begins, which also turns it."""
    stop: tuple[int, ...]
    """Canonical joint at which it ends; its start again for the head, which ends at a point of its own."""
    widths: Float[Tensor, "segments 2 3"]
    """Half widths along the axes of the start's frame at both ends, metres, of the canonical body."""
    is_arm: Bool[Tensor, "2 segments"]
    """Whether each belongs to the arm of a side: left, right."""
    beside: Bool[Tensor, "2 segments"]
    """Whether each is beside the arm of a side while that hangs: trunk and thigh."""


@dataclass(frozen=True, eq=False)
class Segments:
    """The segments of one body in every frame."""

    begin: Float[Tensor, "frames segments 3"]
    """World position at which each begins, metres."""
    end: Float[Tensor, "frames segments 3"]
    """World position at which each ends, metres."""
    quat_xyzw: Float[Tensor, "frames segments 4"]
    """Rotation of each in the world."""
    widths: Float[Tensor, "segments 2 3"]
    """Half widths along its own axes at both ends, metres."""


@dataclass(frozen=True, eq=False)
class Near:
    """Where points are on each segment: the same place may be found on another body."""

    share: Float[Tensor, "frames points segments 1"]
    """Share of the way along the segment's axis to the place nearest to the point."""
    aside: Float[Tensor, "frames points segments 3"]
    """From there to the point, in half widths, along the segment's own axes."""
    away: Float[Tensor, "frames points segments 3"]
    """From the surface to the point, metres, along the segment's own axes; 0 within the body."""
    distance: Float[Tensor, "frames points segments"]
    """From the surface to the point, metres; negative within the body."""
    local: Float[Tensor, "frames points segments 3"]
    """From where the segment begins to the point, metres, along the segment's own axes."""


@cache
def layout() -> Layout:
    """Return the segments of the canonical body."""
    rows = [(start, stop or start, [(x, x, z), (u, u, w)]) for start, stop, (x, z), (u, w) in _TRUNK]
    for name in _SIDES:
        rows += [
            (name + start, name + stop, [(first,) * 3, (last,) * 3]) for start, stop, first, last in (*_LIMBS, *_ARMS)
        ]
    start, stop, widths = zip(*rows, strict=True)
    arms, beside = (
        torch.tensor([[name in {side + part for part in parts} for name in start] for side in _SIDES])
        for parts in (("UpperArm", "LowerArm"), ("UpperLeg",))
    )
    trunk = torch.tensor([name in ("hips", "spine", "chest") for name in start])
    begin, end = (tuple(CANONICAL.indices(names)) for names in (start, stop))
    return Layout(begin, end, torch.tensor(widths, dtype=torch.float64), arms, beside | trunk)


def girth(skeleton: Skeleton) -> float:
    """Return how thick a body of canonical joints is against the canonical one: as it is taller from ankles to neck."""
    trunk = [CANONICAL.index(name) for name in ("spine", "chest", "neck")]
    tall, usual = (leg_length(s) + float(s.offsets[trunk].norm(dim=-1).sum()) for s in (skeleton, CANONICAL))
    return tall / usual


def place_segments(motion: Motion) -> Segments:
    """Place the segments of a body in every frame of a motion of canonical joints."""
    found, size = layout(), girth(motion.skeleton)
    places, turns = motion.joint_positions(), motion.joint_rotations()
    begin, end = places[:, list(found.start)], places[:, list(found.stop)].clone()
    for k, (start, stop) in enumerate(zip(found.start, found.stop, strict=True)):
        if start == stop:
            tip = size * torch.tensor(_HEAD_TIP, dtype=torch.float64)
            end[:, k] = begin[:, k] + rotations.rotate(turns[:, start], tip.expand(len(places), 3))
    return Segments(begin, end, turns[:, list(found.start)], size * found.widths)


def find_nearest(points: Float[Tensor, "frames points 3"], body: Segments) -> Near:
    """Find where points are on each segment of a body."""
    axis = (body.end - body.begin)[:, None]
    way = points[:, :, None] - body.begin[:, None]
    share = (way * axis).sum(-1, keepdim=True) / axis.square().sum(-1, keepdim=True).clamp_min(1e-9)
    share = share.clamp(0, 1)
    turns = rotations.inverse(body.quat_xyzw)[:, None].expand(*share.shape[:3], 4)
    local = rotations.rotate(turns, way)
    aside = local - rotations.rotate(turns, share * axis)
    aside_widths = aside / _width_at(body, share)
    round_off = aside_widths.norm(dim=-1, keepdim=True)
    away = aside * (1 - 1 / round_off.clamp_min(1))
    depth = (aside.norm(dim=-1) / round_off[..., 0].clamp_min(1e-6)) * (round_off[..., 0] - 1)
    return Near(share, aside_widths / round_off.clamp_min(1), away, depth, local)


def place_nearest(near: Near, body: Segments) -> Float[Tensor, "frames points segments 3"]:
    """Return world positions of the same places on another body, metres: as far along each segment and about it, and as
    many metres off its surface."""
    axis = (body.end - body.begin)[:, None]
    turns = body.quat_xyzw[:, None].expand(*near.share.shape[:3], 4)
    aside = rotations.rotate(turns, near.aside * _width_at(body, near.share) + near.away)
    return body.begin[:, None] + near.share * axis + aside


def find_slide(near: Near, body: Segments) -> Float[Tensor, "frames points segments 3"]:
    """Return the directions along which points beside a segment may slide without coming nearer or going farther: its
    axis, of length 1 in the middle and 0 toward its ends, where there is no such direction."""
    axis = torch.nn.functional.normalize(body.end - body.begin, dim=-1)[:, None]
    inside = smootherstep(near.share / _END_SHARE) * smootherstep((1 - near.share) / _END_SHARE)
    return inside * axis


def _width_at(body: Segments, share: Tensor) -> Float[Tensor, "frames points segments 3"]:
    return torch.lerp(body.widths[:, 0], body.widths[:, 1], share)
