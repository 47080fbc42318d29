"""A shot: several wishes that hold at once.

Two levels. The density walks (a receding horizon of MAP windows along a way that is clear of obstacles and others, near
enough to what is reached for), and the in-betweener makes what no density does while it walks: the first and the last
step, and trunk and limbs that reach, with the MAP stage of all in-betweening behind it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.common.character import Character
from controllers.following.follow import FollowSettings, walk_arcs
from controllers.inbetweening.pipeline import fill
from controllers.shots.clips.arrival import arrive
from controllers.shots.clips.lead import go_on
from controllers.shots.joining import TAIL, JoinSettings, Piece, join_pieces, spread_over
from controllers.shots.keys.approaching import check_reaches, go_down, lean_way
from controllers.shots.keys.looking import turn_heads
from controllers.shots.keys.posing import MetPose, as_reaches, meet_poses, pose_frames
from controllers.shots.keys.reaching import ReachTargets, settle_reaches
from controllers.shots.loop import OVERLAP, close_loop
from controllers.shots.planning.timeline import Span, lay_timeline
from controllers.shots.planning.way import Way, cut_curve, plan_way
from controllers.shots.prices import Price
from controllers.shots.repair import repair_jumps
from controllers.shots.request import Reach, ShotRequest
from controllers.shots.rest_pose import build_rest_pose
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


@dataclass(frozen=True)
class ShotSettings:
    """Settings of shots."""

    follow: FollowSettings = field(default_factory=FollowSettings)
    """Sigmas and search of the walks."""
    join: JoinSettings = field(default_factory=JoinSettings)
    """How transitions between standing and walking are tried."""


@dataclass(frozen=True, eq=False, kw_only=True)
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
    prices: tuple[Price, ...] = ()
    """What each wish costs the others, where that was measured."""

    def details(self) -> dict:
        """Return the wishes, and their prices where these were measured."""
        rows = {"wishes": [wish.as_row() for wish in self.wishes]}
        return rows | {"prices": [price.as_row() for price in self.prices]} if self.prices else rows


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
    rest = build_rest_pose(prior, skeleton, character.toe_rest_height)
    told = as_reaches(request.poses, way, rest)
    poses = tuple(key for key in request.poses if not key.joints)
    request = replace(request, reaches=(*request.reaches, *told), poses=poses)
    check_reaches(request.reaches, way, rest)
    way = lean_way(way, request, rest)
    frames = len(way.speeds)
    walked_way = way.walked_on(OVERLAP) if request.loop else way
    pieces, walked = walk_pieces(
        prior, request, walked_way, rest, character=character, settings=settings, generator=generator, progress=progress
    )
    motion, missing = join_pieces(pieces, inbetweener, settings.join)
    if request.lead is not None:
        motion = go_on(motion, missing, request.lead, inbetweener)
    elif bool(missing.any()):
        motion = fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    past = request.lead.past if request.lead is not None else None
    motion = repair_jumps(motion, inbetweener, past=past)
    if request.loop:
        motion = close_loop(motion, frames, inbetweener)
    if request.arrival is not None:
        arrival = request.arrival.bring_to(way.curve, float(way.arcs[-1]))
        motion = arrive(motion, arrival, inbetweener)
    motion, met = meet_poses(motion, request.poses, way, inbetweener)
    reaches = settle_reaches(request.reaches, motion)
    posed = pose_frames(met, frames)
    motion = go_down(motion, reaches, posed)
    if reaches:
        reach = ReachTargets.of(reaches, frames).relaxed(motion).within_reach(motion)
        free = reach.free_limbs(motion.num_joints, posed)
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
        reaches=reaches,
        met=met,
    )


def walk_pieces(
    prior: Density,
    request: ShotRequest,
    way: Way,
    rest: Motion,
    *,
    character: Character,
    settings: ShotSettings,
    generator: torch.Generator,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[Piece], list[tuple[Ledger, tuple[WindowRecord, ...]]]]:
    """Stand and walk along a way, span by span; also return ledger and windows of each walk."""
    frames = len(way.speeds)
    reach = ReachTargets.of(request.reaches, frames)
    pieces, walked = [], []
    for span in lay_timeline(way.speeds, slowest=character.data_limits(prior.limits).slowest):
        if span.what == "stand":
            lead = request.lead if span.start == 0 else None
            standing = _stand(rest, way, span) if lead is None else lead.last_pose
            pieces.append(Piece(span, spread_over(standing, 0, frames)))
            continue
        motion, ledger, windows = _walk(
            prior, way, span, request, reach, character=character, settings=settings, generator=generator
        )
        pieces.append(Piece(span, spread_over(motion, span.start, frames)))
        walked.append((ledger, windows))
        if progress is not None:
            progress(span.stop, frames)
    return pieces, walked


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
    """Walk the frames of a span, and some more at its last speed where another span follows."""
    tail = TAIL if span.stop < len(way.speeds) else 0
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
    arc = way.arcs[span.start]
    return move_to(rotate_about_vertical(rest, way.curve.heading(arc)), way.curve.ground_point(arc))


def _join_ledgers(ledgers) -> Ledger:
    whole = Ledger()
    for ledger in ledgers:
        whole = whole.join(ledger)
    return whole
