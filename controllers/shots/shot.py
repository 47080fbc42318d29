"""A shot: several wishes that hold at once.

Two levels. The density walks (a receding horizon of MAP windows along a way that is clear of obstacles and others, near
enough to what is reached for), and the in-betweener makes what no density does while it walks: the first and the last
step, and trunk and limbs that reach, with the MAP stage of all in-betweening behind it.

Spans of a shot joined into one motion: when the first step begins and which foot takes the last one.

Both are choices with several basins: a few frames earlier another foot is in the air. A grid is tried; what the
in-betweener makes of it is judged as a viewer would.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import pairwise, product
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.character import Character
from controllers.inbetweening.pipeline import fill
from controllers.shots.reaching import (
    STRETCHED_SHARE,
    MetPose,
    ReachTargets,
    as_reaches,
    build_rest_pose,
    check_reaches,
    go_down,
    lean_way,
    look_where_hands_reach,
    measure_look_errors,
    measure_pose_error,
    meet_poses,
    pose_frames,
    settle_reaches,
    turn_heads,
)
from controllers.shots.request import (
    Filling,
    Look,
    PoseKey,
    Reach,
    ShotRequest,
    Transition,
    arrive,
    choose_filling,
    go_on,
    join_across,
    measure_transition_cost,
)
from controllers.shots.walk import FollowSettings, check_path, check_tracking, walk_arcs
from controllers.shots.way import Span, Way, cut_curve, lay_timeline, plan_way
from mapctl.curves import Curve
from mapctl.curves.obstacles import measure_clearance
from mapctl.errors import MapctlError, RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import compute_target_errors
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.path import SpeedProfile, find_reversals, walk_at_ease
from mapctl.kinematics.moving import move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.problem.receding_horizon import CommittedFrames
from mapctl.problem.solution import Ledger, Outcome, Solution, Status
from mapctl.protocols import Density, Inbetweener
from mapctl.runtime.progress import Progress
from mapctl.skeleton import CANONICAL, LIMBS, TOES, Skeleton
from mapctl.terms import KeepApart, KeepClear, Term

TAIL = 14
"""Frames that a walk goes on for a later last step."""
_STILL_START, _STILL_END = 12, 26  # frames of standing at least, where a shot begins and ends with it
_SHORTEST = 12  # frames of a transition
_HASTY = 20  # frames of a transition for which there is no room
_SETTLED = 8  # frames that are left of a walk between two transitions


@dataclass(frozen=True, eq=False)
class Piece:
    """One span's motion, over all frames of the shot; frames outside of it hold."""

    span: Span
    """The span."""
    motion: Motion
    """As many frames as the shot has."""


@dataclass(frozen=True)
class _Room:
    """Where a transition may lie: so many frames after a span's edge, so long."""

    edge: int
    """Frame from which steps count."""
    steps: tuple[int, ...]
    """Frames after the edge that are tried on a grid, rising."""
    lengths: tuple[int, ...]
    """Lengths that are tried on a grid, rising."""
    counts_stop: bool
    """Whether the edge is the next span's, so that steps are of the transition's end."""
    earliest: int
    """First frame that it may take."""
    latest: int
    """One past the last frame that it may take."""

    def lay(self, step: int, length: int) -> Transition | None:
        """Lay the transition; None where there is no room for it."""
        start = self.edge + step - (length if self.counts_stop else 0)
        found = Transition(start, start + length)
        fits = self.earliest <= found.start and found.stop <= self.latest and length >= _SHORTEST
        return found if fits else None


def join_pieces(pieces: Sequence[Piece], inbetweener: Inbetweener) -> tuple[Motion, Bool[Tensor, " frames"]]:
    """Join pieces by the transitions that cost least; also return the frames that the in-betweener is to make."""
    joined = pieces[0].motion
    missing = torch.zeros(joined.num_frames, dtype=torch.bool)
    earliest = 0
    for before, after in pairwise(pieces):
        room = _find_room(before.span, after.span, joined.num_frames, earliest)
        grid = [found for step, length in product(room.steps, room.lengths) if (found := room.lay(step, length))]
        cost = partial(measure_transition_cost, joined, after.motion, inbetweener=inbetweener)
        chosen = min(grid, key=cost) if len(grid) > 1 else grid[0] if grid else None
        if chosen is None:
            chosen = _lay_hasty_transition(before.span, after.span, joined.num_frames, earliest)
        joined = join_across(joined, after.motion, chosen)
        missing[chosen.start : chosen.stop] = True
        earliest = chosen.stop + _SETTLED
    return joined, missing


def _find_room(before: Span, after: Span, frames: int, earliest: int) -> _Room:
    """Find where a transition from one span to the next may lie, so that enough is left of both."""
    own = before.start + (_SETTLED if before.what == "walk" else _STILL_START if before.start == 0 else 1)
    latest = after.stop - 1
    if after.what == "stand" and after.stop == frames:
        latest = min(latest, frames - _STILL_END)
    earliest = max(earliest, own)
    if before.what == "walk":
        return _Room(before.stop, (-12, -8, -4, 0, 4, 8), (26, 34), False, earliest, latest)
    # From standing to walking one may begin at once; from a stand to the next there may be more than a step.
    longest = after.start - (earliest if after.what == "walk" else before.stop)
    lengths = tuple(sorted({18, 26, longest}))
    return _Room(after.start, (0, 4, 8, 12, 16), lengths, True, earliest, latest)


def _lay_hasty_transition(before: Span, after: Span, frames: int, earliest: int) -> Transition:
    """Lay the transition where no candidate fits: as late as the standing after it allows."""
    stop = min(after.start + 1, after.stop - 1)
    if after.what == "stand" and after.stop == frames:
        stop = min(stop, frames - _STILL_END)
    start = max(earliest, min(before.stop - 1, stop - _HASTY))
    return Transition(start, max(start + 1, stop))


def spread_over(motion: Motion, start: int, frames: int) -> Motion:
    """Place a motion's first frame at `start` of a shot; frames before and after hold its ends."""
    source = (torch.arange(frames) - start).clamp(0, motion.num_frames - 1)
    return replace(
        motion,
        root_position=motion.root_position[source].double(),
        local_quat_xyzw=motion.local_quat_xyzw[source].double(),
    )


_TOES = list(CANONICAL.indices(TOES))
_TRIES = 5  # walks of a span, of which the first that passes is taken, or the best
_MOST_OFF, _MOST_BENT = 0.3, 70.0  # metres from where the hips were to be; m/s^2 of a toe: a circle's is 45


def walk_pieces(
    prior: Density,
    request: ShotRequest,
    way: Way,
    rest: Motion,
    *,
    character: Character,
    settings: FollowSettings,
    generator: torch.Generator,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    deadline: float | None = None,
) -> tuple[list[Piece], list[CommittedFrames], Outcome]:
    """Stand and walk along a way, span by span; also return what was solved for each walk, and how that ended."""
    frames, outcome = len(way.speeds), Outcome.DONE
    reach = ReachTargets.of(request.reaches, frames)
    pieces, walked = [], []
    slowest = character.data_limits(prior.limits).slowest
    walks_only = request.walks_only  # at a speed that is nearly none, too
    for span in [Span("walk", 0, frames)] if walks_only else lay_timeline(way.speeds, slowest=slowest):
        if span.what == "stand":
            lead = request.lead if span.start == 0 else None
            standing = _stand(rest, way, span) if lead is None else lead.last_pose
            pieces.append(Piece(span, spread_over(standing, 0, frames)))
            continue
        motion, done, outcome = _walk(
            prior,
            way,
            span,
            request,
            reach,
            character=character,
            settings=settings,
            generator=generator,
            terms=terms,
            progress=progress,
            deadline=deadline,
        )
        part = motion if outcome is not Outcome.DONE else spread_over(motion, span.start, frames)
        pieces.append(Piece(span, part))
        walked.append(done)
    return pieces, walked, outcome


def _walk(
    prior: Density,
    way: Way,
    span: Span,
    request: ShotRequest,
    reach: ReachTargets,
    *,
    character: Character,
    settings: FollowSettings,
    generator: torch.Generator,
    terms: Sequence[Term],
    progress: Progress | None,
    deadline: float | None,
) -> tuple[Motion, CommittedFrames, Outcome]:
    """Walk the frames of a span, and some more at its last speed where another span follows."""
    tail = TAIL if span.stop < len(way.speeds) else 0
    frames = span.stop - span.start + tail
    arcs = _extend(way.arcs[span.start : span.stop], tail + settings.window.frames)
    curve = way.curve
    if span.start > 0:
        curve, arcs = cut_curve(curve, float(arcs[0]), float(arcs[-1]) + 1.0), arcs - arcs[0]

    def terms_of(first: int, count: int) -> Sequence[Term]:
        begin = span.start + first
        found = [*terms, *reach.terms(character.skeleton, begin, count)]
        if request.obstacles:
            found.append(KeepClear(request.obstacles))
        if request.others is not None:
            last = request.others.hips.shape[1] - 1
            hips = request.others.hips[:, torch.arange(begin, begin + count).clamp(max=last)]
            found.append(KeepApart(hips, request.others.distance + 0.05))
        return found

    def report_frames(done: int, _: int) -> None:
        if progress is not None:
            progress(min(span.start + done, span.stop), len(way.speeds))

    start = request.lead.start(prior, character) if request.lead is not None and span.start == 0 else None
    best, least = None, math.inf
    for _ in range(_TRIES if not request.walks_only or _pivots(request, way.curve) else 1):
        motion, done, outcome = walk_arcs(
            prior,
            curve,
            arcs,
            frames,
            character=character,
            settings=settings,
            generator=generator,
            terms_of=terms_of,
            start=start,
            first_frame=span.start,
            progress=report_frames,
            deadline=deadline,
        )
        if outcome is not Outcome.DONE:
            if request.walks_only:
                return motion, done, outcome
            if outcome is Outcome.INTERRUPTED:  # half a shot is none: its other half would stand still
                raise KeyboardInterrupt
            raise MapctlError(f"the walk from frame {span.start} on {outcome.value}")
        fault = _judge_walk(motion, curve.ground_point(arcs[:frames]))
        if fault < least:
            best, least = (motion, done, outcome), fault
        if fault <= 1:
            break
    assert best is not None
    return best


def _judge_walk(motion: Motion, wanted: Float[Tensor, "frames 2"]) -> float:
    """Return how faulty a walk is, 1 where it just passes: how far the hips come to be from where they were to be at
    that time, and the largest acceleration of a toe. A walk now and then gets stuck in a corner, or lunges out of it;
    another one that begins otherwise does not."""
    off = float((motion.root_position[:, ::2] - wanted.to(motion.root_position)).norm(dim=-1).max())
    toes = motion.joint_positions()[:, _TOES]
    bent = float(torch.diff(toes, n=2, dim=0).norm(dim=-1).max()) * PRIOR_FPS**2 if len(toes) > 2 else 0.0
    return max(off / _MOST_OFF, bent / _MOST_BENT)


def _extend(arcs: Float[Tensor, " frames"], more: int) -> Float[Tensor, " ahead"]:
    """Go on at the last speed."""
    return torch.cat([arcs, arcs[-1] + (arcs[-1] - arcs[-2]) * torch.arange(1, more + 1)])


def _stand(rest: Motion, way: Way, span: Span) -> Motion:
    """Stand where the way is during a span, facing along it."""
    arc = way.arcs[span.start]
    return move_to(rotate_about_vertical(rest, way.curve.heading(arc)), way.curve.ground_point(arc))


_PATH_TOLERANCE = 0.15  # metres
_REACH_TOLERANCE = 0.01  # metres
_POSE_TOLERANCE, _FACING_TOLERANCE_DEG = 0.001, 0.1  # metres
_LOOK_TOLERANCE_DEG = 15.0
_STILL_TOLERANCE = 0.06  # m/s
_PROGRESS_TOLERANCE = 0.5  # metres from where one is to be at a time
_SEAM_RATIO = 1.2  # of a loop's largest step from one frame to the next
_NEAR_KEY_SECONDS = 1.0
_ASIDE = 0.05  # metres beside the curve, from which on a way is bent toward a reach
_STILL_AT_START, _STILL_AT_END = 12, 24  # frames at PRIOR_FPS in which one is to stand, beginning and ending
_FIGHT_FRAMES = 20  # before and after a wish, in which others are against it


@dataclass(frozen=True)
class Wish:
    """One wish of a shot."""

    name: str
    """What was wished."""
    asked: str
    """What was asked, in numbers."""
    got: float
    """What it came to, in the unit of `unit`."""
    limit: float
    """Value beyond which it does not hold, in the same unit."""
    unit: str
    """Unit of both."""
    at_least: bool = False
    """Whether `limit` is a least value; else a largest one."""
    remedy: str = ""
    """What would let it hold; empty where it does, or where nothing is known to."""
    seconds: tuple[float, float] | None = None
    """From when to when it is wished, seconds since the first frame; None is throughout."""

    @property
    def holds(self) -> bool:
        """Whether the wish holds."""
        return self.got >= self.limit if self.at_least else self.got <= self.limit

    @property
    def residual(self) -> float:
        """By how much it does not hold, in `unit`; 0 where it does."""
        return max(0.0, self.limit - self.got if self.at_least else self.got - self.limit)

    @property
    def sentence(self) -> str:
        """Say by how much it does not hold."""
        remedy = f" ({self.remedy} would do)" if self.remedy else ""
        return f"{self.name} ({self.asked}): {self.got:.1f} {self.unit}, {self.residual:.1f} {self.unit} short{remedy}"

    def as_row(self) -> dict[str, Any]:
        """Return the wish as a report shows it."""
        return {
            "wish": self.name,
            "asked": self.asked,
            "got": self.got,
            "unit": self.unit,
            "residual": self.residual,
            "holds": self.holds,
            "remedy": self.remedy,
            "seconds": self.seconds,
        }


def check_wishes(request: ShotRequest, way: Way, motion: Motion, met: Sequence[MetPose] = ()) -> tuple[Wish, ...]:
    """Measure every wish of a request on its motion, at PRIOR_FPS; poses as they were met."""
    positions = motion.joint_positions()
    hips = positions[:, 0, ::2]
    away = _find_frames_away(request, way)
    found = [_check_path(way, positions[:, 0], away), _check_progress(way, hips, away)]
    if request.loop:
        found.append(_check_seam(positions))
    for reach in request.reaches:
        targets = ReachTargets.of((reach,), motion.num_frames).targets
        miss = 100 * float(compute_target_errors(positions, targets).max())
        name = f"{', '.join(reach.places)} at {round(reach.seconds, 2):g} s"
        asked = f"held {reach.hold_seconds:g} s" if reach.hold_seconds else "there"
        limit = 100 * max(_REACH_TOLERANCE, max(map(reach.tolerance_of, reach.places)))
        remedy = _find_remedy(reach, motion) if miss > limit else ""
        found.append(Wish(name, asked, miss, limit, "cm", remedy=remedy, seconds=_span(reach)))
    for one in met:
        found.append(_check_pose(one, motion))
    for look in request.looks:
        worst = float(measure_look_errors(motion, look).max())
        name = f"look at {round(look.seconds, 2):g} s"
        found.append(Wish(name, "straight", worst, _LOOK_TOLERANCE_DEG, "degrees", seconds=_span(look)))
    if request.obstacles:
        clear = 100 * float(measure_clearance(request.obstacles, positions[..., ::2]).amin())
        found.append(Wish("obstacles", "no joint within", clear, 0.0, "cm", at_least=True))
    if request.others is not None and not request.others.courtesy:
        last = request.others.hips.shape[1] - 1
        there = request.others.hips[:, torch.arange(len(hips)).clamp(max=last)]
        apart = 100 * float((hips[None] - there).norm(dim=-1).amin())
        asked = f"{request.others.distance:g} m"
        found.append(Wish("keep apart", asked, apart, 100 * request.others.distance - 1.0, "cm", at_least=True))
    still, last = 100 * torch.diff(hips, dim=0).norm(dim=-1) * PRIOR_FPS, (motion.num_frames - 1) / PRIOR_FPS
    limit = 100 * _STILL_TOLERANCE
    if request.stand_at_start:
        moved = float(still[:_STILL_AT_START].mean())
        seconds = (0.0, _STILL_AT_START / PRIOR_FPS)
        found.append(Wish("stand at the start", "still", moved, limit, "cm/s", seconds=seconds))
    if request.stand_at_end:
        moved = float(still[-_STILL_AT_END:].mean())
        seconds = (last - _STILL_AT_END / PRIOR_FPS, last)
        found.append(Wish("stand at the end", "still", moved, limit, "cm/s", seconds=seconds))
    return tuple(found)


def describe_fights(wishes: Sequence[Wish], way: Way, motion: Motion) -> list[str]:
    """Describe every wish that does not hold: by how much, what else is wished at that time and how that fares there,
    and what would settle it."""
    sentences, offsets = [], _measure_offsets(way, motion.root_position)
    for one in wishes:
        if one.holds:
            continue
        rivals = [other for other in wishes if other is not one and not other.holds and _overlap(one, other)]
        fares = [f"{other.name}, {other.residual:.1f} {other.unit} short" for other in rivals]
        if one.seconds is not None:
            first, last = (round(second * PRIOR_FPS) for second in one.seconds)
            near = slice(max(0, first - _FIGHT_FRAMES), last + _FIGHT_FRAMES)
            fares.append(f"the path, {100 * float(offsets[near].max()):.0f} cm off at that time")
        sentences.append(one.sentence + (f"; against {', '.join(fares)}" if fares else ""))
    return sentences


def _overlap(one: Wish, other: Wish) -> bool:
    """Return whether two wishes are at one time."""
    if one.seconds is None or other.seconds is None:
        return True
    apart = _FIGHT_FRAMES / PRIOR_FPS
    return one.seconds[0] - apart < other.seconds[1] and other.seconds[0] - apart < one.seconds[1]


def _span(key: Reach | Look | PoseKey) -> tuple[float, float]:
    return key.seconds, key.seconds + key.hold_seconds


def _check_pose(met: MetPose, motion: Motion) -> Wish:
    """Measure how far what a key tells is missed."""
    metres, degrees = measure_pose_error(motion, met)
    key = met.key
    asked = f"held {key.hold_seconds:g} s" if key.hold_seconds else "there"
    if key.tells_facing_alone:
        limit = max(_FACING_TOLERANCE_DEG, key.most)
        name = f"facing {key.facing_deg:g} degrees at {key.seconds:.2f} s"
        return Wish(name, asked, degrees, limit, "degrees", seconds=_span(key))
    what = "pose" if key.tells_body else "hips"
    limit = 100 * max(_POSE_TOLERANCE, key.most)
    return Wish(f"{what} at {key.seconds:.2f} s", asked, 100 * metres, limit, "cm", seconds=_span(key))


def _find_remedy(reach: Reach, motion: Motion) -> str:
    """Find when the character comes within reach of the place, or by how much nearer it would have to be; nothing where
    it is within reach at the wanted time, and something else is in the way."""
    lacking = torch.zeros(motion.num_frames, dtype=torch.float64)
    for name, place in reach.places.items():
        limb = LIMBS[name]
        away = motion.joint_positions()[:, limb.upper] - motion.root_position.new_tensor(place)
        lacking = torch.maximum(lacking, away.norm(dim=-1) - STRETCHED_SHARE * limb.length(motion.skeleton))
    wanted = reach.seconds * PRIOR_FPS
    within = (lacking <= 0).nonzero()[:, 0]
    if len(within):
        late = (float(within[(within - wanted).abs().argmin()]) - wanted) / PRIOR_FPS
        return f"{abs(late):.1f} s {'later' if late > 0 else 'earlier'}" if abs(late) >= 0.05 else ""
    return f"{100 * float(lacking.min()):.0f} cm nearer"


def _check_path(way: Way, hips: Tensor, away: Tensor) -> Wish:
    """Measure the mean distance to the way in the frames that are `away` from keys."""
    off = _measure_offsets(way, hips)
    return Wish("path", "on the curve", 100 * float(off[away].mean()), 100 * _PATH_TOLERANCE, "cm")


def _check_progress(way: Way, hips: Tensor, away: Tensor) -> Wish:
    """Measure how far the hips come to be from where they are to be at that time, on the way as it is bent."""
    behind = (hips - way.curve.ground_point(way.arcs)).norm(dim=-1)[away]
    return Wish("progress", "on time", 100 * float(behind.max()), 100 * _PROGRESS_TOLERANCE, "cm")


def _check_seam(positions: Tensor) -> Wish:
    """Measure the step from a loop's last frame to its first beside the largest within it."""
    steps = torch.diff(torch.cat([positions, positions[:1]]), dim=0).norm(dim=-1).amax(dim=1) * PRIOR_FPS
    most = _SEAM_RATIO * float(steps[:-1].max())
    return Wish("loop", "last frame leads into the first", float(steps[-1]), most, "m/s")


def _find_frames_away(request: ShotRequest, way: Way) -> Tensor:
    """Find the frames that are away from reaches and poses and from where the way is bent; all where none is."""
    away = way.aside < _ASIDE
    for key in (*request.reaches, *request.poses):
        first = (key.seconds - _NEAR_KEY_SECONDS) * PRIOR_FPS
        last = (key.seconds + key.hold_seconds + _NEAR_KEY_SECONDS) * PRIOR_FPS
        away[max(0, math.floor(first)) : max(0, math.ceil(last))] = False
    return away if bool(away.any()) else torch.ones_like(away)


def _measure_offsets(way: Way, hips: Tensor) -> Tensor:
    """Measure the distance of the hips to the way by frame, metres: over the ground, or in space if the curve is."""
    points = hips if way.wished.dims == 3 else hips[:, ::2]
    return (points - way.wished.point(way.wished.nearest(points, way.wished_arcs))).norm(dim=-1)


OVERLAP = 54
"""Frames, at PRIOR_FPS, that a walk goes on for after once around."""
_EARLIEST, _LATEST = 16, 44  # frames after the first at which laps may be joined: about a stride
_TRIED = 3  # of the best of them
_WIDTHS = (3, 6, 10)  # frames on either side that are tried


def close_loop(motion: Motion, frames: int, inbetweener: Inbetweener) -> Motion:
    """Return one lap of so many frames of a walk that goes on for OVERLAP more: its second lap's first frames, and then
    the first lap's from where both are most alike."""
    here, later = _describe(motion, 0), _describe(motion, frames)
    count = min(len(here), len(later))
    unlike = (here[:count] - later[:count]).norm(dim=-1)
    order = unlike[_EARLIEST:_LATEST].argsort()[:_TRIED] + _EARLIEST
    tried = [_join(motion, frames, int(seam), width) for seam in order for width in _WIDTHS]
    chosen = tried[choose_filling(tried, inbetweener)]
    return fill(chosen.motion, chosen.missing, inbetweener).motion


def _describe(motion: Motion, start: int) -> Float[Tensor, "frames numbers"]:
    """Return places of joints and their steps, by frame from a first one on."""
    places = motion.joint_positions()[start:].flatten(1)
    steps = torch.diff(places, dim=0)
    return torch.cat([places[1:], 3.0 * steps], dim=-1)


def _join(motion: Motion, frames: int, seam: int, width: int) -> Filling:
    source = torch.arange(frames)
    source[:seam] += frames
    missing = torch.zeros(frames, dtype=torch.bool)
    missing[seam - width : seam + width] = True
    joined = replace(motion, root_position=motion.root_position[source], local_quat_xyzw=motion.local_quat_xyzw[source])
    mask = MissingMask.of_frames(missing, motion.num_joints)
    return Filling(joined, mask, (seam - width, seam + width))


_ENDS = list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))
_JUMP_SPEED = 3.0  # m/s about the hips
_JUMP_RATIO = 1.6  # of the speed two frames earlier and later: limbs that swing fast do so for longer
_AROUND = 6  # frames before and after a jump


def repair_jumps(motion: Motion, inbetweener: Inbetweener, *, past: Motion | None = None) -> Motion:
    """Make frames around jumps anew, where that is calmer; the first and the last frame stay. `past` are the frames
    before the first, where there are any."""
    if past is not None:
        whole = repair_jumps(past.join(motion), inbetweener)
        return replace(
            motion,
            root_position=torch.cat([motion.root_position[:1], whole.root_position[past.num_frames + 1 :]]),
            local_quat_xyzw=torch.cat([motion.local_quat_xyzw[:1], whole.local_quat_xyzw[past.num_frames + 1 :]]),
        )
    jumps = find_jumps(motion)
    missing = torch.zeros(motion.num_frames, dtype=torch.bool)
    for frame in jumps.nonzero()[:, 0].tolist():
        missing[max(1, frame - _AROUND) : frame + _AROUND + 2] = True
    missing[-1] = False
    if not bool(missing.any()):
        return motion
    made = fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    return made if _find_peak(made) < _find_peak(motion) else motion


def _find_peak(motion: Motion) -> float:
    """Find the largest second difference of hands and toes, metres: fast limbs that were no jump are made no better."""
    return float(torch.diff(motion.joint_positions()[:, _ENDS], n=2, dim=0).norm(dim=-1).max())


def find_jumps(motion: Motion) -> Bool[Tensor, " steps"]:
    """Find the steps from one frame to the next in which a hand or a toe moves much faster than shortly before and
    after."""
    places = motion.joint_positions()
    speed = torch.diff(places[:, _ENDS] - places[:, :1], dim=0).norm(dim=-1) * PRIOR_FPS
    beside = torch.full_like(speed, torch.inf)  # at the ends nothing shows what was before, or comes after
    beside[2:-2] = torch.maximum(speed[:-4], speed[4:])
    return ((speed > _JUMP_SPEED) & (speed > _JUMP_RATIO * beside)).any(dim=1)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ShotSolution(Solution):
    """A shot's motion and what became of every wish."""

    way: Way
    """The way that was planned."""
    wishes: tuple[Wish, ...] = ()
    """Each wish: asked, got, and the residual."""
    reaches: tuple[Reach, ...] = ()
    """What is reached for, keys' own hands and feet too, at the times at which it was."""
    met: tuple[MetPose, ...] = ()
    """Keys of poses, places and facings, as they were met."""

    def details(self) -> dict:
        """Return the wishes."""
        return {"wishes": [wish.as_row() for wish in self.wishes]}


def solve_shot(
    prior: Density,
    inbetweener: Inbetweener | None,
    request: ShotRequest,
    *,
    generator: torch.Generator | None = None,
    settings: FollowSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    deadline_seconds: float | None = None,
) -> ShotSolution:
    """Make a motion in which all wishes of the request hold, at PRIOR_FPS, on the canonical joints of `skeleton`.

    Where nothing but a walk is requested, no `inbetweener` is needed, and after `deadline_seconds` of wall clock, and
    at Ctrl-C, the solution so far is returned and the status says so. `terms` are the caller's own, in every window of
    the walks; they see the character at its own size and the time since the first frame. On another `skeleton`
    strides are as long as its legs, and the toes' rest height is that of the settings' footing. Wishes that do not hold
    are named with numbers in the status, which is then infeasible.
    """
    if inbetweener is None and not request.walks_only:
        raise RequestError("standing, reversing, keys and clips need an in-betweener, and none is given")
    began, settings = time.perf_counter(), settings or FollowSettings()
    deadline = None if deadline_seconds is None else time.monotonic() + deadline_seconds
    character = Character(skeleton, settings.footing.rest_height)
    way = plan_way(request)
    rest = build_rest_pose(prior, skeleton, character.toe_rest_height)
    limb_keys = as_reaches(request.poses, way, rest)
    poses = tuple(key for key in request.poses if not key.joints)
    request = replace(request, reaches=(*request.reaches, *limb_keys), poses=poses)
    check_reaches(request.reaches, way, rest)
    way = lean_way(way, request, rest)
    if _pivots(request, way.curve):
        settings = replace(settings, footing=replace(settings.footing, heels=None))
    pieces, walked, outcome = walk_pieces(
        prior,
        request,
        way.walked_on(OVERLAP) if request.loop else way,
        rest,
        character=character,
        settings=settings,
        generator=generator or torch.Generator().manual_seed(0),
        terms=terms,
        progress=progress,
        deadline=deadline,
    )
    motion, reaches, met = pieces[0].motion, request.reaches, ()
    if inbetweener is not None:
        motion = _join_walks(pieces, request, way, inbetweener)
        motion, reaches, met = _meet_keys(motion, request, way, inbetweener)
    notes = [way.note] if way.note else []
    if request.walks_only and request.speed is not None:
        notes += check_path(way.curve, way.arcs, character.data_limits(prior.limits))
    if request.walks_only:
        notes += check_tracking(motion, way.curve)
    way = way.slice(motion.num_frames)
    wishes = check_wishes(replace(request, reaches=reaches), way, motion, met)
    notes += describe_fights(wishes, way, motion)
    return ShotSolution(
        motion,
        Status(outcome).with_notes(notes, infeasible=bool(notes)),
        character.ledger(reduce(Ledger.join, (done.ledger for done in walked), Ledger())),
        tuple(window for done in walked for window in done.windows),
        walked[0].features if request.walks_only else None,
        time.perf_counter() - began,
        way=way,
        wishes=wishes,
        reaches=reaches,
        met=met,
    )


def follow(
    prior: Density,
    curve: Curve,
    *,
    seconds: float | None = None,
    speed: float | SpeedProfile | None = None,
    inbetweener: Inbetweener | None = None,
    generator: torch.Generator | None = None,
    settings: FollowSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    terms: Sequence[Term] = (),
    progress: Progress | None = None,
    deadline_seconds: float | None = None,
) -> ShotSolution:
    """Walk a character along a curve from its first point, facing along it: a shot with nothing but a curve.

    `speed` is m/s or a profile along the arc; without one it is the usual speed, and less in corners. Without `seconds`
    the curve is walked once. An `inbetweener` is needed where the curve reverses. See `solve_shot` for the rest.
    RequestError for requests that make no sense; infeasible ones are named with numbers in the status.
    """
    profile = SpeedProfile.constant(speed) if isinstance(speed, float | int) else speed
    return solve_shot(
        prior,
        inbetweener,
        ShotRequest(curve, profile, seconds),
        generator=generator,
        settings=settings,
        skeleton=skeleton,
        terms=terms,
        progress=progress,
        deadline_seconds=deadline_seconds,
    )


def _pivots(request: ShotRequest, curve: Curve) -> bool:
    """Return whether a foot pivots while it lies flat: in corners of a curve that are slowed for."""
    return request.speed is None and bool(len(walk_at_ease(curve).speeds) > 1 or find_reversals(curve))


def _join_walks(pieces: Sequence[Piece], request: ShotRequest, way: Way, inbetweener: Inbetweener) -> Motion:
    """Join stands and walks into one motion that goes on from, ends in, or comes round to what is asked for."""
    motion, missing = join_pieces(pieces, inbetweener)
    if request.lead is not None:
        motion = go_on(motion, missing, request.lead, inbetweener)
    elif bool(missing.any()):
        motion = fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    past = request.lead.past if request.lead is not None else None
    motion = repair_jumps(motion, inbetweener, past=past)
    if request.loop:
        motion = close_loop(motion, len(way.speeds), inbetweener)
    if request.arrival is not None:
        arrival = request.arrival.bring_to(way.curve, float(way.arcs[-1]))
        motion = arrive(motion, arrival, inbetweener)
    return motion


def _meet_keys(
    motion: Motion, request: ShotRequest, way: Way, inbetweener: Inbetweener
) -> tuple[Motion, tuple[Reach, ...], tuple[MetPose, ...]]:
    """Let a walked motion meet poses, then reaches, then looks; also return reaches and poses as they were met."""
    motion, met = meet_poses(motion, request.poses, way, inbetweener)
    reaches = settle_reaches(request.reaches, motion)
    posed = pose_frames(met, len(way.speeds))
    motion = go_down(motion, reaches, posed)
    if reaches:
        reach = ReachTargets.of(reaches, len(way.speeds)).relaxed(motion).within_reach(motion)
        free = reach.free_limbs(motion.num_joints, posed)
        motion = fill(motion, free, inbetweener, targets=reach.led_there(motion).targets).motion
    motion = look_where_hands_reach(motion, reaches, request.looks, posed)
    return turn_heads(motion, request.looks), reaches, tuple(met)
