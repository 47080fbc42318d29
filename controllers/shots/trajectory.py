"""The root trajectory of a shot: where the hips are to be in each frame, clear of obstacles and of others, and the
spans in which the character stands or walks."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from controllers.shots.footsteps import CORNER, Displacement
from controllers.shots.request import Others, PoseKey, ShotRequest
from mapctl import curves, kinematics, rotations
from mapctl.curves import Curve
from mapctl.curves.obstacles import measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.intent.path import PathRequest, SpeedProfile, TimedSpeed, find_reversals, integrate_speeds, walk_at_ease
from mapctl.kinematics.moving import move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals

ClearanceOf = Callable[[Float[Tensor, "arcs offsets 2"], Float[Tensor, " arcs"]], Float[Tensor, "arcs offsets"]]
"""Ground points and their arcs to the distance by which they are clear, metres; negative where it is not."""


_WIDEST, _OFFSET_STEP = 3.0, 0.025  # metres of the largest sideways offset, and between the offsets that are tried
_ARC_SPACING = 0.05  # metres between the arcs at which offsets are chosen
_STEEPEST = 1.0  # largest change of the offset per metre of arc
_DECAY = 0.6  # metres of arc over which an offset that is no longer needed falls by a factor of e
_DETOUR_BEND = 0.5  # metres of arc over which a detour bends: the root of what bending costs beside the offset


def find_detour(curve: Curve, clearance: ClearanceOf) -> Float[Tensor, " arcs"] | None:
    """Find sideways offsets, metres to the left, at arcs 5 cm apart, under which a curve keeps clear.

    Dynamic programming over the arcs: the sum of squared offsets and slopes is least among all paths on the grid. The
    offset at the start is 0, and so is that at the end, where that is free. None where no path leads through.
    """
    arcs = torch.linspace(0, curve.length, max(2, round(curve.length / _ARC_SPACING) + 1), dtype=torch.float64)
    count = 2 * round(_WIDEST / _OFFSET_STEP) + 1
    offsets = torch.linspace(-_WIDEST, _WIDEST, count, dtype=torch.float64)
    points = curve.ground_point(arcs)[:, None] + offsets[:, None] * curve.left(arcs)[:, None]
    free = (clearance(points, arcs) >= 0).numpy()
    chosen = _choose_offsets(free, offsets.numpy())
    return None if chosen is None else torch.from_numpy(_smooth_offsets(free, offsets.numpy(), chosen))


def apply_detour(curve: Curve, offsets: Float[Tensor, " knots"]) -> Curve:
    """Return the curve moved sideways by offsets at evenly spaced arcs, as `find_detour` returns them."""
    if not bool((offsets.abs() > 1e-3).any()):
        return curve
    fine = torch.linspace(0, curve.length, max(2, round(curve.length / 0.02)), dtype=torch.float64)
    moved = curve.point(fine).clone()
    moved[:, curve.ground_axes] = _ground_beside(curve, offsets, fine)
    return curves.from_points(moved, closed=False)


def _ground_beside(curve: Curve, offsets: Tensor, arcs: Float[Tensor, " arcs"]) -> Float[Tensor, "arcs 2"]:
    return curve.ground_point(arcs) + _interpolate(curve, offsets, arcs)[:, None] * curve.left(arcs)


def _interpolate(curve: Curve, values: Tensor, arcs: Float[Tensor, " arcs"]) -> Float[Tensor, " arcs"]:
    """Interpolate values at evenly spaced arcs of a curve to others, metres."""
    knots = torch.linspace(0, curve.length, len(values), dtype=torch.float64)
    return torch.from_numpy(np.interp(arcs.numpy(), knots.numpy(), values.numpy()))


def _choose_offsets(free: ndarray, offsets: ndarray) -> ndarray | None:
    """Choose the number of the cheapest offset at each arc; None where every path is blocked."""
    reach = max(1, round(_STEEPEST * _ARC_SPACING / _OFFSET_STEP))
    slopes = np.arange(-reach, reach + 1) * _OFFSET_STEP / _ARC_SPACING
    cost, came_from = np.full(len(offsets), np.inf), []
    cost[len(offsets) // 2] = 0.0 if free[0, len(offsets) // 2] else np.inf
    for row in free[1:]:
        padded = np.pad(cost, reach, constant_values=np.inf)
        moves = np.stack([padded[k : k + len(offsets)] for k in range(2 * reach + 1)])
        moves += (_DECAY * slopes[:, None]) ** 2
        best = moves.argmin(axis=0)
        cost = np.where(row, moves[best, np.arange(len(offsets))] + offsets**2, np.inf)
        came_from.append(best - reach)
    if not np.isfinite(cost).any():
        return None
    middle = len(offsets) // 2
    at = middle if np.isfinite(cost[middle]) else int(cost.argmin())  # it ends where the curve does, if that is free
    chosen = [at]
    for back in reversed(came_from):
        at += int(back[at])
        chosen.append(at)
    return np.array(chosen[::-1])


def _smooth_offsets(free: ndarray, offsets: ndarray, chosen: ndarray) -> ndarray:
    """Minimise offsets, slopes and bends between the walls on either side of the chosen path."""
    lowest, highest = np.empty(len(chosen)), np.empty(len(chosen))
    for arc, (row, at) in enumerate(zip(free, chosen, strict=True)):
        walls = np.flatnonzero(~row)
        below, above = walls[walls < at], walls[walls > at]
        lowest[arc] = offsets[below[-1] + 1] if len(below) else offsets[0]
        highest[arc] = offsets[above[0] - 1] if len(above) else offsets[-1]
    lowest[0] = highest[0] = 0.0
    lowest[-1] = highest[-1] = offsets[chosen[-1]]
    widened = np.maximum(highest, lowest + 1e-6)  # the solver wants some room
    line = np.eye(len(chosen))
    slopes, bends = np.diff(line, axis=0) / _ARC_SPACING, np.diff(line, 2, axis=0) / _ARC_SPACING**2
    rows = np.concatenate([line, _DECAY * slopes, _DETOUR_BEND**2 * bends])
    wanted = scipy.sparse.csr_array(rows)
    return scipy.optimize.lsq_linear(wanted, np.zeros(len(rows)), bounds=(lowest, widened), tol=1e-8).x


_STANDING_SPEED = 0.05  # m/s
_WALKING_SHARE = 0.7  # of the fastest speed beside a stand, at which the density walks already
_SHORTEST_WALK = 15  # frames, without a stand on either side
_SHORTEST_BETWEEN_STANDS = 30  # frames, less than two steps: footsteps lead from one stand to the next instead


@dataclass(frozen=True, eq=False)
class Span:
    """Frames start to stop in which a character stands or walks."""

    what: Literal["stand", "walk"]
    """Stand or walk."""
    start: int
    """First frame."""
    stop: int
    """One past the last frame."""
    pose: Motion | None = None
    """Pose of a stand, one frame."""


def lay_stands(spans: Sequence[Span], trajectory: "Trajectory", request: ShotRequest, rest: Motion) -> list[Span]:
    """Give each stand its pose: at rest on the trajectory, or that of the clip that is continued or ended in.

    A stand is split where the curve reverses, and where keys displace its feet; the character steps from one part to
    the next."""
    found, frames = list[Span](), len(trajectory.arcs)
    for span in spans:
        if span.what == "walk":
            found.append(span)
            continue
        arc = trajectory.arcs[span.start]
        before, after = (trajectory.curve.heading(arc + side * CORNER) for side in (-1.0, 1.0))
        inside = span.start > 0 and span.stop < frames
        if inside and abs(float(rotations.wrap_angle(after - before))) >= _REVERSAL:
            held = max(1, (span.stop - span.start - round(_TURN_SECONDS * PRIOR_FPS)) // 2)
            found.append(Span("stand", span.start, span.start + held, trajectory.stand(rest, arc, before)))
            found.append(Span("stand", span.stop - held, span.stop, trajectory.stand(rest, arc, after)))
            continue
        pose = trajectory.stand(rest, arc, trajectory.curve.heading(arc))
        if span.start == 0 and request.lead is not None:
            pose = request.lead.last_pose
        elif span.stop == frames and request.arrival is not None:
            pose = request.arrival.bring_to(trajectory.curve, float(trajectory.arcs[-1])).motion.slice(0, 1)
        found += _split_at_keys(replace(span, pose=pose), trajectory, request.poses)
    return found


def _split_at_keys(span: Span, trajectory: "Trajectory", keys: Sequence[PoseKey]) -> list[Span]:
    """Split a stand at the keys for which a foot has to step, and there is time to: there, and back again after it."""
    found, base = [span], span.pose
    assert base is not None
    for key in sorted(keys, key=lambda key: key.seconds):
        first = round(key.seconds * PRIOR_FPS)
        stop = min(span.stop, first + round(key.hold_seconds * PRIOR_FPS) + 1)
        now = found[-1]
        if not max(1, now.start) <= first < span.stop:
            continue
        asked = trajectory.pose_at_key(base, key, first)
        there, back = Displacement.between(now.pose or base, asked), Displacement.between(asked, base)
        leave, home = first - there.count_frames() + 1, stop + back.count_frames() - 2
        if not there.moves_feet or (leave <= now.start and now.start == 0):
            continue
        # A walk that leads into the stand shortly before the key ends in it.
        before = [replace(now, stop=leave + 1)] if leave > now.start else []
        found[-1:] = [*before, Span("stand", first if before else now.start, stop, asked)]
        if home < span.stop:
            found.append(Span("stand", home, span.stop, base))
        else:
            found[-1] = replace(found[-1], stop=span.stop)
    return found


def lay_timeline(speeds: Float[Tensor, " frames"], *, slowest: float) -> list[Span]:
    """Lay out the spans of a shot by its speeds, m/s a frame; between spans, from one to the next, lie transitions.

    A character that never stands walks throughout. A walk beside a stand begins and ends where the requested speed is
    most of the fastest, and no lower than `slowest`, m/s, which the density can walk.
    """
    frames = len(speeds)
    standing = [(start, stop) for _, start, stop in true_intervals((speeds < _STANDING_SPEED)[:, None])]
    if not standing:
        return [Span("walk", 0, frames)]
    spans, before = [], 0
    for start, stop in [*standing, (frames, frames)]:
        if start > before:
            enough = max(slowest, _WALKING_SHARE * float(speeds[before:start].max()))
            fast = before + (speeds[before:start] >= enough).nonzero()[:, 0]
            if len(fast):
                first, last = int(fast[0]) if before > 0 else 0, int(fast[-1]) + 1 if start < frames else frames
                between = before > 0 and start < frames
                if last - first >= (_SHORTEST_BETWEEN_STANDS if between else _SHORTEST_WALK):
                    spans.append(Span("walk", first, last))
        if stop > start:
            spans.append(Span("stand", start, stop))
        before = stop
    # Where there is too little for a walk, it is stepped: from a stand, or to one.
    if spans[0].start > 0:
        spans.insert(0, Span("stand", 0, 1))
    if spans[-1].stop < frames:
        spans.append(Span("stand", frames - 1, frames))
    return spans


@dataclass(frozen=True)
class StandingEnds:
    """Ends of a shot at which the character stands, and how speeds rise and fall there."""

    start: bool
    """Whether it begins standing."""
    end: bool
    """Whether it ends standing."""
    acceleration: float = 1.2
    """Rise and fall of the speed, m/s^2."""
    still: float = 0.5
    """Seconds of standing at the start."""
    settled: float = 1.0
    """Seconds of standing at the end."""

    def limit(self, speeds: Float[Tensor, " frames"], fps: float) -> Float[Tensor, " frames"]:
        """Let speeds by time, m/s, rise from standing and fall to it, where they do not already."""
        seconds, found = torch.arange(len(speeds), dtype=speeds.dtype) / fps, speeds
        if self.start and float(speeds[0]) >= _STANDING_SPEED:
            found = torch.minimum(found, self.acceleration * (seconds - self.still).clamp_min(0))
        if self.end and float(speeds[-1]) >= _STANDING_SPEED:
            found = torch.minimum(found, self.acceleration * (seconds[-1] - seconds - self.settled).clamp_min(0))
        return found


def plan_speeds(
    profile: SpeedProfile, length: float, fps: float, ends: StandingEnds, *, seconds: float | None, most: int
) -> Float[Tensor, " frames"]:
    """Plan speeds along an open curve of some length, m/s a frame: from standing, to standing at its end, or both.

    Without `seconds` it lasts until the curve ends, and the standing beyond; RequestError for more than `most` frames.
    """
    speeds, arc, step = [], 0.0, 1 / fps
    last = math.inf if seconds is None else seconds - step
    while len(speeds) <= most:
        time = len(speeds) * step
        speed = profile.at(arc)
        if ends.start:
            speed = min(speed, ends.acceleration * max(0.0, time - ends.still))
        if ends.end:
            braking = min(length - arc, 0.5 * ends.acceleration * max(0.0, last - ends.settled - time) ** 2)
            speed = min(speed, math.sqrt(2 * ends.acceleration * max(0.0, braking)))
        stopped = ends.end and length - arc < 0.004
        if (seconds is None and (stopped or arc >= length)) or time > last + 1e-9:
            break
        speeds.append(0.0 if stopped else speed)
        arc += speed * step
    if len(speeds) > most:
        raise RequestError(f"more than the {most} frames allowed; ask for fewer seconds or more speed")
    if seconds is None and ends.end:
        speeds += [0.0] * round(ends.settled * fps)
    return torch.tensor(speeds, dtype=torch.float64)


_BODY_MARGIN = 0.35  # metres from the hips to an obstacle's edge: arms swing that far
APART_MARGIN = 0.15
"""Metres beyond the distance to others by which trajectories keep apart: hips sway, and are early or late."""
_TURN_SECONDS, _TURN_HELD = 1.8, 0.2  # of steps where a curve reverses, and of standing before them and after
_REVERSAL = math.radians(60.0)  # between the directions on both sides of a corner
_FINE_STEP = 0.02  # metres of arc
_CATCH_UP = 3.0  # metres of arc over which a longer trajectory is caught up
_MOST_FRAMES = 108_000
_MEETING_FRAMES = 6  # frames by which either may be early or late


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Where a character is to be in each frame."""

    curve: Curve
    """Curve that is clear of obstacles and others, and near enough to what is reached for."""
    speeds: Float[Tensor, " frames"]
    """Speed along it, m/s."""
    arcs: Float[Tensor, " frames"]
    """Arc along it, metres."""
    unbent: Curve
    """Curve before it was bent toward what is reached for."""
    unbent_arcs: Float[Tensor, " frames"]
    """Arc along that, metres."""
    aside: Float[Tensor, " frames"]
    """Distance of the curve from the unbent one, metres."""
    note: str | None = None
    """Changes to the request, or the reason why it cannot hold."""
    blocked: bool = False
    """Whether no path leads around the obstacles and past the others."""

    def stand(self, rest: Motion, arc: Tensor, heading: Tensor) -> Motion:
        """Bring one frame onto the curve at an arc, metres, with a heading, radians."""
        return move_to(rotate_about_vertical(rest, heading), self.curve.ground_point(arc))

    def pose_at_key(self, found: Motion, key: PoseKey, frame: int) -> Motion:
        """Return one frame as a key asks for it, what it does not give as found; a pose without a position and a facing
        is on the curve and along it."""
        pose = found if key.pose is None else key.pose
        root, quats = pose.root_position.double().clone(), pose.local_quat_xyzw.double().clone()
        arc = self.arcs[frame : frame + 1]
        if key.place is not None:
            root[0, ::2] = root.new_tensor(key.place)
        elif key.pose is not None:
            root[0, ::2] = self.curve.ground_point(arc)
        if key.height is not None:
            root[0, 1] = key.height
        angle = None
        if key.facing_deg is not None:
            angle = torch.deg2rad(root.new_tensor([key.facing_deg]))
        elif key.pose is not None:
            angle = self.curve.heading(arc).to(root)
        if angle is not None:
            turn = rotations.about_y(angle - kinematics.heading(quats[:, 0]))
            quats[:, 0] = rotations.multiply(turn, quats[:, 0])
        return replace(found, root_position=root, local_quat_xyzw=quats)

    def slice(self, frames: int) -> "Trajectory":
        """Return the first frames."""
        cut = {name: getattr(self, name)[:frames] for name in ("speeds", "arcs", "unbent_arcs", "aside")}
        return replace(self, **cut)

    def extend_loop(self, frames: int) -> "Trajectory":
        """Return the trajectory of a loop with some more frames, of its next lap."""
        return replace(
            self,
            speeds=torch.cat([self.speeds, self.speeds[:frames]]),
            arcs=torch.cat([self.arcs, self.curve.length + self.arcs[:frames]]),
            unbent_arcs=torch.cat([self.unbent_arcs, self.unbent.length + self.unbent_arcs[:frames]]),
            aside=torch.cat([self.aside, self.aside[:frames]]),
        )


def plan_trajectory(request: ShotRequest) -> Trajectory:
    """Plan the root trajectory of a shot: first around obstacles, then past others, where they are at that time. Where
    no path leads through the curve stays as it is, with a note."""
    plain = _plan_along(request, request.curve)
    if not request.obstacles and request.others is None:
        return plain
    at_start = float(measure_clearance(request.obstacles, request.curve.ground_point(0.0)[None]))

    def clearance(points: Tensor, at: Tensor) -> Tensor:
        # A character that begins beside an obstacle has to get away from it first.
        margin = (at_start + 0.5 * at).clamp(max=_BODY_MARGIN)[:, None]
        clear = measure_clearance(request.obstacles, points) - margin
        if request.others is None:
            return clear
        return torch.minimum(clear, _clear_of_others(points, at, plain.arcs, request.others))

    offsets = find_detour(request.curve, clearance)
    if offsets is None:
        return replace(plain, note="no path leads around the obstacles and past the others", blocked=True)
    return _plan_along(request, apply_detour(request.curve, offsets))


def bend_trajectory(plain: Trajectory, offsets: Float[Tensor, " arcs"], met: Sequence[float]) -> Trajectory:
    """Return a trajectory moved sideways by offsets, metres to the left, at evenly spaced arcs. It passes the arcs
    `met`, metres, at the same times as before: the extra length is caught up gradually before them."""
    curve = apply_detour(plain.curve, offsets)
    if curve is plain.curve:
        return plain
    length = plain.curve.length
    before = torch.linspace(0, length, max(2, round(length / _FINE_STEP) + 1), dtype=torch.float64)
    ground = _ground_beside(plain.curve, offsets, before)
    along = torch.cat([ground.new_zeros(1), torch.diff(ground, dim=0).norm(dim=-1).cumsum(0)])
    longer = np.interp([*sorted(met), length], before.numpy(), (along - before).numpy())
    knots, gained = [0.0], [0.0]
    for arc, extra in zip([*sorted(met), length], longer, strict=True):
        if arc - _CATCH_UP > knots[-1]:
            knots.append(arc - _CATCH_UP)
            gained.append(gained[-1])
        if arc > knots[-1]:
            knots.append(arc)
            gained.append(float(extra))
    arcs = plain.arcs + torch.from_numpy(np.interp(plain.arcs.numpy(), knots, gained))
    speeds = torch.diff(arcs, append=2 * arcs[-1:] - arcs[-2:-1]) * PRIOR_FPS
    aside = _interpolate(plain.curve, offsets.abs(), plain.arcs)
    return replace(plain, curve=curve, speeds=speeds, arcs=arcs, unbent_arcs=plain.arcs, aside=aside)


def _plan_along(request: ShotRequest, curve: Curve) -> Trajectory:
    """Plan the arcs along a curve by frame; a shot without a duration lasts until the curve ends."""
    ends, arcs, note = StandingEnds(request.begins_standing, request.ends_standing), None, None
    if isinstance(request.speed, TimedSpeed):
        frames = max(2, round((request.seconds or 0.0) * PRIOR_FPS))
        speeds = ends.limit(request.speed.at(frames, PRIOR_FPS), PRIOR_FPS)
    elif not curve.closed and (reversals := find_reversals(curve)):
        speeds = _plan_reversals(request.speed or walk_at_ease(curve), request.seconds, curve, reversals, ends)
    else:
        path, note = PathRequest(curve, request.speed or walk_at_ease(curve), request.seconds).fitted(PRIOR_FPS)
        arcs = path.arcs(path.frames(PRIOR_FPS), PRIOR_FPS)
        speeds = torch.tensor([path.profile.at(float(arc)) for arc in arcs], dtype=torch.float64)
        if ends.start or ends.end:
            length = math.inf if curve.closed and request.seconds is not None else curve.length
            speeds = plan_speeds(path.profile, length, PRIOR_FPS, ends, seconds=request.seconds, most=_MOST_FRAMES)
            arcs = note = None
        elif request.loop:  # its frame after its last is its first again
            speeds, arcs = speeds * (curve.length * PRIOR_FPS / speeds.sum()), None
        elif request.speed is None:
            arcs = None
    arcs = integrate_speeds(speeds, PRIOR_FPS) if arcs is None else arcs
    return Trajectory(curve, speeds, arcs, curve, arcs, torch.zeros_like(arcs), note)


def _plan_reversals(
    profile: SpeedProfile, seconds: float | None, curve: Curve, reversals: Sequence[float], ends: StandingEnds
) -> Float[Tensor, " frames"]:
    """Plan speeds along a curve that reverses: to a stand at each reversal, and on from there."""
    stops, speeds = [0.0, *reversals, curve.length], []
    for number, (start, stop) in enumerate(pairwise(stops)):
        piece, turning = ends, _TURN_SECONDS / 2 + _TURN_HELD
        if number > 0:
            piece = replace(piece, start=True, still=turning)
        if number < len(reversals):
            piece = replace(piece, end=True, settled=turning)
        onward = SpeedProfile(tuple(arc - start for arc in profile.arcs), profile.speeds)
        found = plan_speeds(onward, stop - start, PRIOR_FPS, piece, seconds=None, most=_MOST_FRAMES)
        # Rounded to frames, a piece's arcs miss its length by a little.
        speeds.append(found * ((stop - start) * PRIOR_FPS / found.sum()))
    planned = torch.cat(speeds)
    if seconds is None:
        return planned
    frames = max(2, round(seconds * PRIOR_FPS))
    return torch.cat([planned, planned.new_zeros(frames)])[:frames]


def _clear_of_others(
    points: Float[Tensor, "arcs offsets 2"], at: Float[Tensor, " arcs"], arcs: Float[Tensor, " frames"], others: Others
) -> Float[Tensor, "arcs offsets"]:
    """Compute by how much points are clear of others when they are reached."""
    frame = torch.searchsorted(arcs.contiguous(), at.contiguous()).clamp(max=len(arcs) - 1)
    clear = torch.full(points.shape[:2], torch.inf, dtype=points.dtype)
    for late in range(-_MEETING_FRAMES, _MEETING_FRAMES + 1, 3):
        away = (points[None] - others.at(frame + late).to(points)[:, :, None]).norm(dim=-1)
        clear = torch.minimum(clear, away.amin(dim=0))
    return clear - others.distance - APART_MARGIN


def cut_curve(curve: Curve, start: float, stop: float) -> Curve:
    """Return the open piece of a curve between two arcs, metres."""
    arcs = torch.linspace(start, stop, max(2, round((stop - start) / 0.01)) + 1, dtype=torch.float64)
    return replace(curve, points=curve.point(arcs), closed=False)
