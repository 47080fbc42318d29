"""Hands near the body, each other or the floor: where they are relative to these is kept on other bones.

A body is rounded segments between joints, a hand two points, palm and finger tips. For each segment of the source's
body that a point is near, the same place on the receiving body is where that point should be, and all these places are
averaged, the nearest counting most; beside them the position that rotations alone lead to, the more the farther the
hand is from everything. Positions relative to a body's surface are kept in the manner of Molla et al. 2018.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import contacts, kinematics, rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals
from mapctl.retarget.character import ARMS, SIDES, Stance, limb_extension
from mapctl.skeleton import CANONICAL, Skeleton, leg_length

Spans = list[tuple[int, int]]
"""First frames of contacts and one past their last, in order."""

_MERGE_SECONDS = 0.2  # seconds between two contacts at one position that are one
_MERGE_METRES = 0.06  # metres that such contacts are apart at most


def merge_contacts(
    touching: Bool[Tensor, "frames points"], positions: Float[Tensor, "frames points 3"], fps: float
) -> list[Spans]:
    """Return by point the spans in which it touches, merged where they follow soon at one ground position, metres."""
    found: list[Spans] = [[] for _ in range(touching.shape[1])]
    for point, start, stop in true_intervals(touching):
        spans = found[point]
        near = bool(spans) and start - spans[-1][1] < _MERGE_SECONDS * fps
        if near and float((positions[start, point] - positions[spans[-1][1] - 1, point])[::2].norm()) < _MERGE_METRES:
            spans[-1] = (spans[-1][0], stop)
        else:
            spans.append((start, stop))
    return found


def hold_through(spans: Spans, values: Float[Tensor, "spans width"], frames: int) -> Float[Tensor, "frames width"]:
    """Hold one value throughout each span, and go smoothly from one to the next between; there is a span at least."""
    held = values.new_empty(frames, values.shape[1])
    held[: spans[0][0]], held[spans[-1][0] :] = values[0], values[-1]
    for (start, stop), value in zip(spans, values, strict=True):
        held[start:stop] = value
    for (_, stop), (start, _), before, after in zip(spans[:-1], spans[1:], values[:-1], values[1:], strict=True):
        share = torch.arange(1, start - stop + 1, dtype=values.dtype)[:, None] / (start - stop + 1)
        held[stop:start] = before + (after - before) * smootherstep(share)
    return held


def mean_by_span(values: Float[Tensor, "frames width"], spans: Spans) -> Float[Tensor, "spans width"]:
    return torch.stack([values[start:stop].mean(0) for start, stop in spans])


def soft_clamp(
    far: Float[Tensor, "*frames limbs"], most: Float[Tensor, "*#frames limbs"], soft: Float[Tensor, "*#frames limbs"]
) -> Float[Tensor, "*frames limbs"]:
    """Return how far the end of a limb may be, metres: as far as it is, and ever less from `soft` before the most."""
    over = (far - (most - soft)).clamp_min(0)
    return torch.minimum(far, most - soft) + soft * (1 - torch.exp(-over / soft))


_HANDS = [arm.end for arm in ARMS]
_POINTS = (0.08, 0.15)  # metres from the wrist to palm and finger tips along the hand, of the canonical body
_PALM_THICKNESS = 0.03  # metres from the middle of a hand to what it touches, of the canonical body
_TOUCH_METRES, _FAR_METRES = 0.02, 0.16  # metres off a surface within which a hand touches, and from which it is free
_SLIDE_METRES = 0.07  # metres off a surface from which a hand may slide along a limb or the trunk
# Of the arm: from where on it is so straight that it hangs, and from where on it does so entirely.
_HANGS_FROM, _HANGS_TO = 0.86, 0.94
_FADE_SECONDS = 0.12  # seconds over which a relation comes and goes
_SLOW_SPEED, _FAST_SPEED = 0.2, 0.6  # m/s beside a segment up to which a hand stays there, and from which it passes
_SPEED_SECONDS = 0.1  # seconds over which that speed is smoothed
_SHARPNESS = 0.05  # how much less a segment counts that is a little farther than the nearest
_ROUNDS = 3  # times that hands are placed, since each arm is something that the other hand is near
_EASE_WEIGHT = 0.02  # strength from which the arm is solved for entirely
# Of the arm: how straight one may be whatever the source's is, and at most.
_FREE_EXTENSION, _MOST_EXTENSION = 0.98, 0.998
_SOFT_MARGIN = 0.06  # of the arm, before the most that it may be, over which it gives in
_HELD_SPEED = 0.25  # m/s below which a hand on the floor stands on it
_LEAST_STRENGTH = 0.5  # of a relation, from which a hand that does not get there is worth a line
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


_ROWS = [(start, stop or start, [(x, x, z), (u, u, w)]) for start, stop, (x, z), (u, w) in _TRUNK] + [
    (side + start, side + stop, [(first,) * 3, (last,) * 3])
    for side in SIDES
    for start, stop, first, last in (*_LIMBS, *_ARMS)
]
_STARTS = list(CANONICAL.indices([start for start, _, _ in _ROWS]))
_STOPS = list(CANONICAL.indices([stop for _, stop, _ in _ROWS]))
_WIDTHS = torch.tensor([widths for *_, widths in _ROWS], dtype=torch.float64)
# Of each side, left first: whether a segment is of its arm, and whether it is trunk or its thigh, beside a hanging arm.
_IS_ARM, _BESIDE = (
    torch.tensor([[row[0] in (*trunk, *(side + part for part in parts)) for row in _ROWS] for side in SIDES])
    for trunk, parts in (((), ("UpperArm", "LowerArm")), (("hips", "spine", "chest"), ("UpperLeg",)))
)


class _Segments(NamedTuple):
    """The segments of one body in every frame."""

    begin: Float[Tensor, "frames segments 3"]  # world position at which each begins, metres
    end: Float[Tensor, "frames segments 3"]
    quat_xyzw: Float[Tensor, "frames segments 4"]  # rotation of each in the world
    widths: Float[Tensor, "segments 2 3"]  # half widths along its own axes at both ends, metres


class _Near(NamedTuple):
    """Where points are on each segment, along its own axes: the same place may be found on another body."""

    share: Float[Tensor, "frames points segments 1"]  # along the segment to the position nearest to the point
    aside: Float[Tensor, "frames points segments 3"]  # from there to the point, in half widths
    away: Float[Tensor, "frames points segments 3"]  # from the surface to the point, metres; 0 within the body
    distance: Float[Tensor, "frames points segments"]  # the same, metres; negative within the body
    local: Float[Tensor, "frames points segments 3"]  # from where the segment begins to the point, metres


class _Relations(NamedTuple):
    """Surfaces near the source's hands; the points of both hands one after another, left first. Weights are 0 to 1."""

    near: _Near  # to the segments of its body
    weight: Float[Tensor, "frames points segments"]  # how much each counts
    touch: Float[Tensor, "frames points segments"]  # how much it matters where along a segment a point is
    apart: Float[Tensor, "frames 3"]  # from the middle of the left hand to that of the right, metres
    together: Float[Tensor, "frames 1"]  # how much that counts
    floor_height: Float[Tensor, "frames points"]  # of the points, metres, less what a hand is thick
    floor_weight: Float[Tensor, "frames points"]  # how much that counts
    planted: Bool[Tensor, "frames points"]  # whether a point stands on the floor

    def body_strength(self) -> Float[Tensor, "frames 2"]:
        """Return how much hands are bound to body and floor, 0 to 1: about as to what binds them most."""
        weight, influence = self.by_hand()
        return (influence * weight).sum(dim=-1) / influence.sum(dim=-1).clamp_min(1e-9)

    def by_hand(self) -> tuple[Float[Tensor, "frames 2 relations"], Float[Tensor, "frames 2 relations"]]:
        """Return by hand the weights of relations to segments and floor, and influences: the nearest's is greatest."""
        weight = torch.cat([self.weight, self.floor_weight[..., None]], dim=2).unflatten(1, (2, -1)).flatten(2)
        return weight, weight / (1 - weight + _SHARPNESS)


def keep_hand_relations(
    own: Motion, moved: Motion, source: Stance, *, scale: float
) -> tuple[Motion, Float[Tensor, "frames 2"]]:
    """Bring hands to where the source's are relative to body, each other and floor, as far as arms allow; also return
    by how much those that touch something miss it, metres.

    Both are motions of canonical joints, `own` the source's, `moved` with its rotations but of legs on other bones.
    Hands keep their orientation in the world, and elbows go on pointing where they did.
    """
    relations = _find_relations(own, source)
    strength = 1 - (1 - relations.body_strength()) * (1 - relations.together)
    if not bool((strength > 0).any()):
        return moved, torch.zeros(own.num_frames, 2, dtype=torch.float64)
    at_floor = _floor_offsets(own, moved, relations, source, scale=scale)
    straight = limb_extension(own, ARMS)
    done, before = moved, moved.joint_positions()[:, _HANDS]
    offset = missed = torch.zeros_like(before)
    for _ in range(_ROUNDS):
        # If one of two hands that are together falls short, the other comes to it.
        offset = _offset_hands(relations, moved, done, at_floor, relations.together[..., None] * missed)
        done = _reach(moved, offset, strength, straight)
        missed = missed + done.joint_positions()[:, _HANDS] - (before + offset)
    errors = (done.joint_positions()[:, _HANDS] - (before + offset)).norm(dim=-1)
    touch = torch.cat([relations.touch, relations.floor_weight[..., None]], dim=2).unflatten(1, (2, -1))
    touches = torch.maximum(touch.amax(dim=(2, 3)), relations.together) > _LEAST_STRENGTH
    return done, torch.where(touches, errors, 0.0)


def _find_relations(own: Motion, source: Stance) -> _Relations:
    size, fps = _girth(own.skeleton), float(own.fps)
    points, thick = _hand_points(own, size), size * _PALM_THICKNESS
    near = _find_nearest(points, _place_segments(own))
    # No hand is bound to its own arm, and hardly to trunk and thigh while the arm is straight and hangs.
    straight = (limb_extension(own, ARMS) - _HANGS_FROM) / (_HANGS_TO - _HANGS_FROM)
    influence = (1 - smootherstep(straight)[..., None] * _BESIDE.double()) * (~_IS_ARM).double()
    influence = influence.repeat_interleave(len(_POINTS), dim=1)
    # A hand that swings past a segment is not put there.
    stays = torch.ones_like(near.distance)
    if len(points) > 1:
        speed = near.local.diff(dim=0).norm(dim=-1) * fps
        smooth = gaussian.smooth(torch.cat([speed[:1], speed]).flatten(1), _SPEED_SECONDS * fps).view_as(stays)
        stays = 1 - smootherstep((smooth - _SLOW_SPEED) / (_FAST_SPEED - _SLOW_SPEED))
    far = torch.lerp(stays.new_tensor(_SLIDE_METRES), stays.new_tensor(_FAR_METRES), stays)
    weight, touch = (
        gaussian.envelope((influence * _weigh(near.distance - thick, reach)).flatten(1), _FADE_SECONDS, fps).view_as(
            stays
        )
        for reach in (far, _SLIDE_METRES)
    )
    left, right = points.unflatten(1, (2, -1)).unbind(dim=1)
    between = (left[:, :, None] - right[:, None]).norm(dim=-1).flatten(1).amin(dim=1, keepdim=True)
    height = points[..., 1] - source.floor - thick
    # A point stands on the floor that is near it and slow, for a while.
    planted, settings = torch.zeros_like(height, dtype=torch.bool), contacts.ContactSettings()
    if len(points) > 1:
        step = min(len(points) - 1, max(1, round(settings.speed_window * fps)))
        speed = (points[step:] - points[:-step]).norm(dim=-1) * (fps / step)
        slow = torch.cat([speed[:1].expand(step, -1), speed]) < _HELD_SPEED
        shortest = max(1, round(settings.shortest * fps))
        planted = contacts.remove_short_runs(slow & (height < _TOUCH_METRES), shortest)
    return _Relations(
        near=near,
        weight=weight,
        touch=touch,
        apart=(right - left).mean(dim=1),
        together=gaussian.envelope(_weigh(between - 2 * thick), _FADE_SECONDS, fps),
        floor_height=height,
        floor_weight=gaussian.envelope(_weigh(height), _FADE_SECONDS, fps),
        planted=planted,
    )


def _weigh(
    distance: Float[Tensor, "*batch"], far: Float[Tensor, "*batch"] | float = _FAR_METRES
) -> Float[Tensor, "*batch"]:
    """Return how much a relation over a distance counts: entirely where it is a touch, not at all from `far` on."""
    return 1 - smootherstep((distance - _TOUCH_METRES) / (far - _TOUCH_METRES))


def _hand_points(motion: Motion, size: float) -> Float[Tensor, "frames points 3"]:
    """Return the world positions of palms and finger tips, left ones first, metres."""
    along = torch.tensor([[sign * far for far in _POINTS] for sign in (1, -1)], dtype=torch.float64)
    offsets = torch.zeros(*along.shape, 3, dtype=torch.float64)
    offsets[..., 0] = size * along
    turns = motion.joint_rotations()[:, _HANDS, None].expand(-1, -1, len(_POINTS), 4)
    reaching = rotations.rotate(turns, offsets)
    return (motion.joint_positions()[:, _HANDS, None] + reaching).flatten(1, 2)


def _floor_offsets(
    own: Motion, moved: Motion, relations: _Relations, source: Stance, *, scale: float
) -> Float[Tensor, "frames points 3"]:
    """Return offsets, metres, that bring points as high over the floor as the source's and hold what stands on it."""
    size = _girth(moved.skeleton)
    points, given = _hand_points(moved, size), scale * _hand_points(own, _girth(own.skeleton))
    offsets = torch.zeros_like(points)
    offsets[..., 1] = relations.floor_height + source.floor + size * _PALM_THICKNESS - points[..., 1]
    for k, spans in enumerate(merge_contacts(relations.planted, given, float(own.fps))):
        if spans:
            shift = (points - given)[:, k, ::2]
            offsets[:, k, ::2] = hold_through(spans, mean_by_span(shift, spans), len(shift)) - shift
    return offsets


def _offset_hands(
    relations: _Relations,
    moved: Motion,
    done: Motion,
    at_floor: Float[Tensor, "frames points 3"],
    missed: Float[Tensor, "frames 2 3"],
) -> Float[Tensor, "frames 2 3"]:
    """Return where hands should be from where rotations alone lead, metres; `done` shows where the other arm is, and
    `missed` by what hands that are together could not get there."""
    points = _hand_points(moved, _girth(moved.skeleton))
    body = _place_segments(done)
    # The same places on the receiving body: as far along each segment and about it, and as many metres off its surface.
    near, axis = relations.near, (body.end - body.begin)[:, None]
    turns = body.quat_xyzw[:, None].expand(*near.share.shape[:3], 4)
    aside = rotations.rotate(turns, near.aside * _width_at(body, near.share) + near.away)
    toward = body.begin[:, None] + near.share * axis + aside - points[:, :, None]
    # Points beside a segment may slide along its axis, but not toward its ends, where there is no such direction.
    inside = smootherstep(near.share / _END_SHARE) * smootherstep((1 - near.share) / _END_SHARE)
    slide = inside * torch.nn.functional.normalize(body.end - body.begin, dim=-1)[:, None]
    along = (1 - relations.touch[..., None]) * (toward * slide).sum(-1, keepdim=True)
    offsets = torch.cat([toward - along * slide, at_floor[:, :, None]], dim=2).unflatten(1, (2, -1)).flatten(2, 3)
    weight, influence = relations.by_hand()
    total = influence.sum(dim=-1, keepdim=True).clamp_min(1e-9)
    offset = ((influence * weight)[..., None] * offsets).sum(dim=2) / total + missed
    middle = points.unflatten(1, (2, -1)).mean(dim=2) + offset
    missing = relations.together * (relations.apart - (middle[:, 1] - middle[:, 0]))
    # A hand that touches the body stays there; the other comes to it.
    gives = 1 - relations.body_strength()[..., None] + _SHARPNESS
    shares = gives / gives.sum(dim=1, keepdim=True) * gives.new_tensor([[-1.0], [1.0]])
    return offset + shares * missing[:, None]


def _reach(
    moved: Motion,
    offset: Float[Tensor, "frames 2 3"],
    strength: Float[Tensor, "frames 2"],
    straight: Float[Tensor, "frames 2"],
) -> Motion:
    """Bend arms so that hands are moved by an offset, as far as that is in reach without arms that are straighter than
    `straight`, or than most; where relations are weak, hardly."""
    positions, world = moved.joint_positions(), moved.joint_rotations()
    ease, turned = smootherstep(strength / _EASE_WEIGHT), world.clone()
    for k, arm in enumerate(ARMS):
        to_hand = positions[:, arm.end] - positions[:, arm.upper]
        most = straight[:, k, None].clamp(_FREE_EXTENSION, _MOST_EXTENSION) * arm.length(moved.skeleton)
        wanted = to_hand + offset[:, k]
        was, far = to_hand.norm(dim=-1, keepdim=True), wanted.norm(dim=-1, keepdim=True)
        near = torch.minimum(far, torch.maximum(soft_clamp(far, most, _SOFT_MARGIN * most), was))
        direction = wanted * (near / far.clamp_min(1e-9))
        upper, bent = world[:, arm.upper], moved.local_quat_xyzw[:, arm.lower]
        reached = inverse.reach(arm, upper, bent, direction, moved.skeleton.offsets)
        upper, bent = (rotations.slerp(a, b, ease[:, k]) for a, b in zip((upper, bent), reached, strict=True))
        turned[:, arm.upper], turned[:, arm.lower] = upper, rotations.multiply(upper, bent)
    local = kinematics.local_from_world(moved.skeleton.parents, turned)
    return replace(moved, local_quat_xyzw=rotations.make_sign_continuous(local))


def _girth(skeleton: Skeleton) -> float:
    """Return how thick a body of canonical joints is against the canonical one: as it is taller from ankles to neck."""
    trunk = [CANONICAL.index(name) for name in ("spine", "chest", "neck")]
    tall, usual = (leg_length(s) + float(s.offsets[trunk].norm(dim=-1).sum()) for s in (skeleton, CANONICAL))
    return tall / usual


def _place_segments(motion: Motion) -> _Segments:
    """Place the segments of a body in every frame of a motion of canonical joints."""
    size, positions, turns = _girth(motion.skeleton), motion.joint_positions(), motion.joint_rotations()
    begin, end = positions[:, _STARTS], positions[:, _STOPS].clone()
    tip = size * torch.tensor(_HEAD_TIP, dtype=torch.float64)
    skull = len(_TRUNK) - 1
    end[:, skull] = begin[:, skull] + rotations.rotate(turns[:, _STARTS[skull]], tip)
    return _Segments(begin, end, turns[:, _STARTS], size * _WIDTHS)


def _find_nearest(points: Float[Tensor, "frames points 3"], body: _Segments) -> _Near:
    axis = (body.end - body.begin)[:, None]
    offset = points[:, :, None] - body.begin[:, None]
    share = (offset * axis).sum(-1, keepdim=True) / axis.square().sum(-1, keepdim=True).clamp_min(1e-9)
    share = share.clamp(0, 1)
    turns = rotations.inverse(body.quat_xyzw)[:, None].expand(*share.shape[:3], 4)
    local = rotations.rotate(turns, offset)
    aside = local - rotations.rotate(turns, share * axis)
    aside_widths = aside / _width_at(body, share)
    round_off = aside_widths.norm(dim=-1, keepdim=True)
    away = aside * (1 - 1 / round_off.clamp_min(1))
    depth = (aside.norm(dim=-1) / round_off[..., 0].clamp_min(1e-6)) * (round_off[..., 0] - 1)
    return _Near(share, aside_widths / round_off.clamp_min(1), away, depth, local)


def _width_at(body: _Segments, share: Tensor) -> Float[Tensor, "frames points segments 3"]:
    return torch.lerp(body.widths[:, 0], body.widths[:, 1], share)
