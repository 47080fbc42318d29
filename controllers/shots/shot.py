"""A shot: several wishes that hold at once.

Two levels. The density walks (a receding horizon of MAP windows along a way that is clear of obstacles and others, near
enough to what is reached for), and the in-betweener makes what no density does while it walks: the first and the last
step, and trunk and limbs that reach, with the MAP stage of all in-betweening behind it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.following.follow import FollowSettings, walk_arcs
from controllers.inbetweening.pipeline import fill
from controllers.shots.arrival import arrive
from controllers.shots.looking import turn_heads
from controllers.shots.loop import OVERLAP, close_loop
from controllers.shots.posing import as_reaches, meet_poses, pose_frames
from controllers.shots.prices import Price
from controllers.shots.reaching import ReachTargets, check_reaches, settle_reaches
from controllers.shots.request import ShotRequest
from controllers.shots.rest_pose import build_rest_pose
from controllers.shots.timeline import Span, lay_timeline
from controllers.shots.transitions import Transition, choose_transition, join_across
from controllers.shots.way import Way, cut_curve, plan_way
from controllers.shots.wishes import Wish, check_wishes, describe_fights
from mapctl.errors import MapctlError
from mapctl.inbetweening.missing import MissingMask
from mapctl.kinematics.placing import move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Solution, Status, WindowRecord
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.terms import KeepApart, KeepClear, Term

_TAIL = 14  # frames that a walk goes on for a later last step
_STILL_START, _STILL_END = 12, 26  # frames of standing at least, where a shot begins and ends with it
_SHORTEST = 12  # frames of a transition
_HASTY = 20  # frames of a transition for which there is no room
_SETTLED = 8  # frames that are left of a walk between two transitions


@dataclass(frozen=True)
class ShotSettings:
    """Settings of shots."""

    follow: FollowSettings = field(default_factory=FollowSettings)
    """Sigmas and search of the walks."""
    first_steps: tuple[int, ...] = (0, 4, 8, 12, 16)
    """Frames after the earliest one at which a walk may have begun."""
    first_lengths: tuple[int, ...] = (18, 26)
    """Lengths of the transition into a walk that are tried, frames."""
    last_steps: tuple[int, ...] = (-12, -8, -4, 0, 4, 8)
    """Frames after the one at which the speed falls at which a walk may end."""
    last_lengths: tuple[int, ...] = (26, 34)
    """Lengths of the transition out of a walk that are tried, frames."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShotSolution(Solution):
    """A shot's motion and what became of every wish."""

    way: Way
    """The way that was planned."""
    wishes: tuple[Wish, ...] = ()
    """Each wish: asked, got, and the residual."""
    prices: tuple[Price, ...] = ()
    """What each wish costs the others, where that was measured."""

    def details(self) -> dict:
        """Return the wishes, and their prices where these were measured."""
        rows = {"wishes": [wish.as_row() for wish in self.wishes]}
        return rows | {"prices": [price.as_row() for price in self.prices]} if self.prices else rows


@dataclass(frozen=True, eq=False)
class _Piece:
    """One span's motion, over all frames of the shot; frames outside of it hold."""

    span: Span
    motion: Motion


def solve_shot(
    prior: Density,
    inbetweener: Inbetweener,
    request: ShotRequest,
    *,
    generator: torch.Generator | None = None,
    settings: ShotSettings | None = None,
    skeleton: Skeleton = CANONICAL,
    progress: Callable[[int, int], None] | None = None,
) -> ShotSolution:
    """Make a motion in which all wishes of the request hold, at PRIOR_FPS, on the canonical joints of `skeleton`.

    Wishes that do not hold are named with numbers in the status, which is then infeasible.
    """
    began = time.perf_counter()
    settings, generator = settings or ShotSettings(), generator or torch.Generator().manual_seed(0)
    character = Character(skeleton, settings.follow.footing.rest_height)
    way = plan_way(request)
    frames = len(way.speeds)
    rest = build_rest_pose(prior, skeleton, character.toe_rest_height)
    told = as_reaches(request.poses, way, rest)
    poses = tuple(key for key in request.poses if not key.joints)
    request = replace(request, reaches=(*request.reaches, *told), poses=poses)
    reach = ReachTargets.of(request.reaches, frames)
    walked_way = way.walked_on(OVERLAP) if request.loop else way
    spans = lay_timeline(walked_way.speeds, slowest=character.data_limits(prior.limits).slowest)
    check_reaches(request.reaches, way, rest)
    pieces, walked = [], []
    for span in spans:
        if span.what == "stand":
            if span.start == 0 and request.lead is not None:
                standing = request.lead.last_pose
            else:
                standing = _stand(rest, way, span)
            pieces.append(_Piece(span, _spread_over(standing, 0, frames)))
            continue
        motion, ledger, windows = _walk(
            prior, walked_way, span, request, reach, character=character, settings=settings, generator=generator
        )
        pieces.append(_Piece(span, _spread_over(motion, span.start, len(walked_way.speeds))))
        walked.append((ledger, windows))
        if progress is not None:
            progress(span.stop, len(walked_way.speeds))
    motion, missing = _join_pieces(pieces, inbetweener, settings)
    if bool(missing.any()):
        motion = fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    if request.loop:
        motion = close_loop(motion, frames, inbetweener)
    if request.arrival is not None:
        arrival = request.arrival.bring_to(way.curve, float(way.arcs[-1]))
        motion = arrive(motion, arrival, inbetweener)
    motion, met = meet_poses(motion, request.poses, way, inbetweener)
    reaches = settle_reaches(request.reaches, motion)
    if reaches:
        reach = ReachTargets.of(reaches, frames).relaxed(motion).within_reach(motion)
        free = reach.free_limbs(motion.num_joints, pose_frames(met, frames))
        motion = fill(motion, free, inbetweener, targets=reach.led_there(motion).targets).motion
    motion = turn_heads(motion, request.looks)
    wishes = check_wishes(replace(request, reaches=reaches), way, motion, met)
    notes = [way.note] if way.note else []
    notes += describe_fights(wishes, way, motion)
    return ShotSolution(
        motion,
        Status(Outcome.DONE).with_notes(notes, infeasible=bool(notes)),
        character.ledger(_join_ledgers(ledger for ledger, _ in walked)),
        tuple(window for _, windows in walked for window in windows),
        seconds=time.perf_counter() - began,
        way=way,
        wishes=wishes,
    )


def _walk(
    prior: Density,
    way: Way,
    span: Span,
    request: ShotRequest,
    reach: ReachTargets,
    *,
    character: Character,
    settings: ShotSettings,
    generator: torch.Generator,
) -> tuple[Motion, Ledger, tuple[WindowRecord, ...]]:
    """Walk the frames of a span and some more, which go on at its last speed."""
    tail = _TAIL if span.stop < len(way.speeds) else 0
    frames = span.stop - span.start + tail
    arcs = _extend(way.arcs[span.start : span.stop], tail + settings.follow.window.frames)
    curve = way.curve
    if span.start > 0:
        curve, arcs = cut_curve(curve, float(arcs[0]), float(arcs[-1]) + 1.0), arcs - arcs[0]

    def terms_of(first: int, count: int) -> Sequence[Term]:
        begin = span.start + first
        terms: list[Term] = list(reach.terms(character.skeleton, begin, count))
        if request.obstacles:
            terms.append(KeepClear(request.obstacles))
        if request.others is not None:
            last = request.others.hips.shape[1] - 1
            hips = request.others.hips[:, torch.arange(begin, begin + count).clamp(max=last)]
            terms.append(KeepApart(hips, request.others.distance + 0.05))
        return terms

    motion, done, outcome = walk_arcs(
        prior,
        curve,
        arcs,
        frames,
        character=character,
        settings=settings.follow,
        generator=generator,
        terms_of=terms_of,
        start=request.lead.start(prior, character) if request.lead is not None and span.start == 0 else None,
    )
    if outcome is Outcome.INTERRUPTED:  # half a shot is none: its other half would stand still
        raise KeyboardInterrupt
    if outcome is not Outcome.DONE:
        raise MapctlError(f"the walk from frame {span.start} on {outcome.value}")
    return motion, done.ledger, done.windows


def _extend(arcs: Float[Tensor, " frames"], more: int) -> Float[Tensor, " ahead"]:
    """Go on at the last speed."""
    return torch.cat([arcs, arcs[-1] + (arcs[-1] - arcs[-2]) * torch.arange(1, more + 1)])


def _stand(rest: Motion, way: Way, span: Span) -> Motion:
    """Stand where the way is during a span, facing along it."""
    arc = way.arcs[span.start : span.start + 1]
    place, tangent = way.curve.point(arc)[0, :: way.curve.dims - 1], way.curve.tangent(arc)[0]
    turned = rotate_about_vertical(rest, torch.atan2(tangent[0], tangent[-1]))
    return move_to(turned, place)


def _spread_over(motion: Motion, start: int, frames: int) -> Motion:
    """Place a motion's first frame at `start` of a shot; frames before and after hold its ends."""
    source = (torch.arange(frames) - start).clamp(0, motion.num_frames - 1)
    return replace(
        motion,
        root_position=motion.root_position[source].double(),
        local_quat_xyzw=motion.local_quat_xyzw[source].double(),
    )


def _join_pieces(pieces: Sequence[_Piece], inbetweener: Inbetweener, settings: ShotSettings) -> tuple[Motion, Tensor]:
    """Join pieces by the transitions that cost least; also return the frames that the in-betweener is to make."""
    joined = pieces[0].motion
    missing = torch.zeros(joined.num_frames, dtype=torch.bool)
    earliest = 0
    for before, after in pairwise(pieces):
        candidates = [
            one
            for one in _list_transitions(before.span, after.span, joined.num_frames, settings)
            if one.start >= earliest
        ] or [_lay_hasty_transition(before.span, after.span, joined.num_frames, earliest)]
        chosen = choose_transition(joined, after.motion, candidates, inbetweener)
        joined = join_across(joined, after.motion, chosen)
        missing[chosen.start : chosen.stop] = True
        earliest = chosen.stop + _SETTLED
    return joined, missing


def _lay_hasty_transition(before: Span, after: Span, frames: int, earliest: int) -> Transition:
    """Lay the transition where no candidate fits: as late as the standing after it allows."""
    stop = min(after.start + 1, after.stop - 1)
    if after.what == "stand" and after.stop == frames:
        stop = min(stop, frames - _STILL_END)
    start = max(earliest, min(before.stop - 1, stop - _HASTY))
    return Transition(start, max(start + 1, stop))


def _list_transitions(before: Span, after: Span, frames: int, settings: ShotSettings) -> list[Transition]:
    """List the transitions from one span to the next that leave enough of both."""
    earliest = before.start + (_SETTLED if before.what == "walk" else _STILL_START if before.start == 0 else 1)
    latest = after.stop - 1
    if after.what == "stand" and after.stop == frames:
        latest = min(latest, frames - _STILL_END)
    if before.what == "walk":
        pairs = product(settings.last_steps, settings.last_lengths)
        found = [Transition(before.stop + step, before.stop + step + length) for step, length in pairs]
    elif after.what == "walk":
        pairs = product(settings.first_steps, settings.first_lengths)
        found = [Transition(after.start + step - length, after.start + step) for step, length in pairs]
        found += [Transition(earliest, after.start + step) for step in settings.first_steps]
    else:
        found = [Transition(before.stop, after.start + late) for late in (1, 6)]
        pairs = product(settings.first_steps, settings.first_lengths)
        found += [Transition(after.start + step - length, after.start + step) for step, length in pairs]
    return [one for one in found if earliest <= one.start and one.stop <= latest and one.stop - one.start >= _SHORTEST]


def _join_ledgers(ledgers) -> Ledger:
    whole = Ledger()
    for ledger in ledgers:
        whole = whole.join(ledger)
    return whole
