"""The way of a shot: its curve led around obstacles and others, and the arc along it at each frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.planning.timeline import StandingEnds, limit_timed_speeds, plan_speeds
from controllers.shots.request import Others, ShotRequest
from mapctl.curves import Curve
from mapctl.curves.detour import apply_detour, find_detour, find_ground_beside, interpolate_evenly
from mapctl.curves.obstacles import measure_clearance
from mapctl.features import PRIOR_FPS
from mapctl.intent.cornering import find_reversals, slow_for_corners
from mapctl.intent.path import PathRequest, SpeedProfile
from mapctl.intent.timed_speed import TimedSpeed, integrate_speeds
from mapctl.numerics import vectors

_BODY_MARGIN = 0.35  # metres from the hips to an obstacle's edge: arms swing that far
APART_MARGIN = 0.15
"""Metres beyond the distance to others by which ways keep apart: hips sway, and are early or late."""
_TURN_SECONDS = 0.6  # of standing where a curve reverses
_FINE_STEP = 0.02  # metres of arc
_MADE_UP = 3.0  # metres of arc over which one makes up for a longer way
_MOST_FRAMES = 108_000
_MEETING_FRAMES = 6  # frames by which either may be early or late


@dataclass(frozen=True, eq=False)
class Way:
    """Where a character is to be at each frame."""

    curve: Curve
    """Curve that is clear of obstacles and others, and near enough to what is reached for."""
    speeds: Float[Tensor, " frames"]
    """Speed along it, m/s."""
    arcs: Float[Tensor, " frames"]
    """Arc along it, metres."""
    wished: Curve
    """Curve before it was bent toward what is reached for."""
    wished_arcs: Float[Tensor, " frames"]
    """Arc along that, metres."""
    aside: Float[Tensor, " frames"]
    """How far aside of that the way leads, metres."""
    note: str | None = None
    """What was changed about the request, or why it cannot hold."""

    def walked_on(self, frames: int) -> "Way":
        """Return the way of a loop, walked on for some more frames."""
        return replace(
            self,
            speeds=torch.cat([self.speeds, self.speeds[:frames]]),
            arcs=torch.cat([self.arcs, self.curve.length + self.arcs[:frames]]),
            wished_arcs=torch.cat([self.wished_arcs, self.wished.length + self.wished_arcs[:frames]]),
            aside=torch.cat([self.aside, self.aside[:frames]]),
        )


def plan_way(request: ShotRequest) -> Way:
    """Plan the way of a shot: first around obstacles, then past others, who are met where the plan is when they are
    there. Where no way leads through the curve stays as it is, and a note says so."""
    speeds = _plan_speeds(request, request.curve)
    arcs = integrate_speeds(speeds, PRIOR_FPS)
    if not request.obstacles and request.others is None:
        return _plain(request.curve, speeds)

    at_start = float(measure_clearance(request.obstacles, request.curve.ground_point(0.0)[None]))

    def clearance(points: Tensor, at: Tensor) -> Tensor:
        # Who begins beside an obstacle has to get away from it first.
        margin = (at_start + 0.5 * at).clamp(max=_BODY_MARGIN)[:, None]
        clear = measure_clearance(request.obstacles, points) - margin
        return (
            clear
            if request.others is None
            else torch.minimum(clear, _clear_of_others(points, at, arcs, request.others))
        )

    offsets = find_detour(request.curve, clearance)
    if offsets is None:
        note = "no way leads around the obstacles and past the others"
        return replace(_plain(request.curve, speeds), note=note)
    curve = apply_detour(request.curve, offsets)
    speeds = _plan_speeds(request, curve)
    return _plain(curve, speeds)


def _plain(curve: Curve, speeds: Float[Tensor, " frames"]) -> Way:
    arcs = integrate_speeds(speeds, PRIOR_FPS)
    return Way(curve, speeds, arcs, curve, arcs, torch.zeros_like(arcs))


def bend_way(way: Way, offsets: Float[Tensor, " arcs"], met: Sequence[float]) -> Way:
    """Return a way moved sideways by offsets, metres to the left, at evenly spaced arcs. Whenever one would have been
    at one of the arcs `met`, metres, one is beside it: what a bend is longer by is made up for gradually before."""
    curve = apply_detour(way.curve, offsets)
    if curve is way.curve:
        return way
    length = way.curve.length
    before = torch.linspace(0, length, max(2, round(length / _FINE_STEP) + 1), dtype=torch.float64)
    ground = find_ground_beside(way.curve, offsets, before)
    along = torch.cat([ground.new_zeros(1), vectors.length(torch.diff(ground, dim=0)).cumsum(0)])
    longer = np.interp([*sorted(met), length], before.numpy(), (along - before).numpy())
    knots, gained = [0.0], [0.0]
    for arc, extra in zip([*sorted(met), length], longer, strict=True):
        if arc - _MADE_UP > knots[-1]:
            knots.append(arc - _MADE_UP)
            gained.append(gained[-1])
        if arc > knots[-1]:
            knots.append(arc)
            gained.append(float(extra))
    arcs = way.arcs + torch.from_numpy(np.interp(way.arcs.numpy(), knots, gained))
    speeds = torch.diff(arcs, append=2 * arcs[-1:] - arcs[-2:-1]) * PRIOR_FPS
    moved = interpolate_evenly(way.curve, offsets.abs(), way.arcs)
    return replace(way, curve=curve, speeds=speeds, arcs=arcs, wished_arcs=way.arcs, aside=moved)


def _plan_speeds(request: ShotRequest, curve: Curve) -> Float[Tensor, " frames"]:
    """Plan the speed at each frame; a shot without a duration lasts until the curve ends."""
    ends = StandingEnds(request.begins_standing, request.ends_standing)
    if isinstance(request.speed, TimedSpeed):
        frames = max(2, round((request.seconds or 0.0) * PRIOR_FPS))
        return limit_timed_speeds(request.speed.at(frames, PRIOR_FPS), PRIOR_FPS, ends)
    if (reversals := find_reversals(curve)) and not curve.closed:
        return _plan_reversals(request, curve, reversals, ends)
    path, _ = PathRequest(curve, slow_for_corners(curve, request.speed), request.seconds).fitted(PRIOR_FPS)
    frames = path.frames(PRIOR_FPS)
    if ends.start or ends.end:
        length = math.inf if curve.closed and request.seconds is not None else curve.length
        return plan_speeds(path.profile, length, PRIOR_FPS, ends, seconds=request.seconds, most=_MOST_FRAMES)
    arcs = path.arcs(frames, PRIOR_FPS)
    speeds = torch.tensor([path.profile.at(float(arc)) for arc in arcs], dtype=torch.float64)
    # A loop's frame after its last is its first again.
    return speeds * (curve.length * PRIOR_FPS / speeds.sum()) if request.loop else speeds


def _plan_reversals(
    request: ShotRequest, curve: Curve, reversals: Sequence[float], ends: StandingEnds
) -> Float[Tensor, " frames"]:
    """Plan speeds along a curve that reverses: to a standing at each reversal, and on from there."""
    assert isinstance(request.speed, SpeedProfile)
    profile, stops, speeds = slow_for_corners(curve, request.speed), [0.0, *reversals, curve.length], []
    for number, (start, stop) in enumerate(pairwise(stops)):
        last = number == len(reversals)
        piece = replace(
            ends,
            start=ends.start if number == 0 else True,
            end=ends.end if last else True,
            still=ends.still if number == 0 else _TURN_SECONDS / 2,
            settled=ends.settled if last else _TURN_SECONDS / 2,
        )
        onward = SpeedProfile(tuple(arc - start for arc in profile.arcs), profile.speeds)
        found = plan_speeds(onward, stop - start, PRIOR_FPS, piece, seconds=None, most=_MOST_FRAMES)
        # Rounded to frames, a piece's arcs miss its length by a little.
        speeds.append(found * ((stop - start) * PRIOR_FPS / found.sum()))
    planned = torch.cat(speeds)
    if request.seconds is None:
        return planned
    frames = max(2, round(request.seconds * PRIOR_FPS))
    return torch.cat([planned, planned.new_zeros(frames)])[:frames]


def _clear_of_others(
    points: Float[Tensor, "arcs offsets 2"], at: Float[Tensor, " arcs"], arcs: Float[Tensor, " frames"], others: Others
) -> Float[Tensor, "arcs offsets"]:
    """Compute by how much points are clear of others when they are reached."""
    frame = torch.searchsorted(arcs.contiguous(), at.contiguous()).clamp(max=len(arcs) - 1)
    clear = torch.full(points.shape[:2], torch.inf, dtype=points.dtype)
    last = others.hips.shape[1] - 1
    for late in range(-_MEETING_FRAMES, _MEETING_FRAMES + 1, 3):
        there = others.hips[:, (frame + late).clamp(0, last)].to(points)
        away = vectors.length(points[None] - there[:, :, None])
        clear = torch.minimum(clear, away.amin(dim=0))
    return clear - others.distance - APART_MARGIN


def cut_curve(curve: Curve, start: float, stop: float) -> Curve:
    """Return the open piece of a curve between two arcs, metres."""
    arcs = torch.linspace(start, stop, max(2, round((stop - start) / 0.01)) + 1, dtype=torch.float64)
    return replace(curve, points=curve.point(arcs), closed=False)
