"""A shot: several wishes that hold at once.

Two levels. The density walks (a receding horizon of MAP windows along a way that is clear of obstacles and others, near
enough to what is reached for), and the in-betweener makes what no density does while it walks: the first and the last
step, and trunk and limbs that reach, with the MAP stage of all in-betweening behind it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch

from controllers.common.character import Character
from controllers.following.follow import FollowSettings
from controllers.inbetweening.pipeline import fill
from controllers.shots.clips.arrival import arrive
from controllers.shots.clips.lead import go_on
from controllers.shots.joining import JoinSettings, Piece, join_pieces
from controllers.shots.keys.approaching import check_reaches, go_down, lean_way
from controllers.shots.keys.looking import look_where_hands_reach, turn_heads
from controllers.shots.keys.posing import MetPose, as_reaches, meet_poses, pose_frames
from controllers.shots.keys.reaching import ReachTargets, settle_reaches
from controllers.shots.loop import OVERLAP, close_loop
from controllers.shots.planning.way import Way, plan_way
from controllers.shots.repair import repair_jumps
from controllers.shots.request import Reach, ShotRequest
from controllers.shots.rest_pose import build_rest_pose
from controllers.shots.walking import walk_pieces
from controllers.shots.wishes import Wish, check_wishes, describe_fights
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Solution, Status
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, Skeleton

_CORNER_STEP, _CORNER_CURVATURE = 0.1, 1.5
# metres between the places where a way's curvature is looked at, and the 1/m from which on it is a corner


@dataclass(frozen=True)
class ShotSettings:
    """Settings of shots."""

    follow: FollowSettings = field(default_factory=FollowSettings)
    """Sigmas and search of the walks."""
    join: JoinSettings = field(default_factory=JoinSettings)
    """How transitions between standing and walking are tried."""


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
    walked_way = way.walked_on(OVERLAP) if request.loop else way
    pieces, walked = walk_pieces(
        prior,
        request,
        walked_way,
        rest,
        character=character,
        settings=_free_heels_at_corners(settings.follow, way),
        generator=generator,
        progress=progress,
    )
    motion = _join_walks(pieces, request, way, inbetweener, settings.join)
    motion, reaches, met = _meet_keys(motion, request, way, inbetweener)
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


def _free_heels_at_corners(settings: FollowSettings, way: Way) -> FollowSettings:
    """Leave heels out of the footing where a way has a corner: a foot pivots there while it lies flat."""
    curve = way.curve
    arcs = torch.arange(0.0, curve.length, _CORNER_STEP, dtype=torch.float64)
    turning = curve.curvature(arcs).abs()
    cornered = len(turning) > 0 and float(turning.max()) > _CORNER_CURVATURE
    return replace(settings, footing=replace(settings.footing, heels=None)) if cornered else settings


def _join_walks(
    pieces: Sequence[Piece], request: ShotRequest, way: Way, inbetweener: Inbetweener, settings: JoinSettings
) -> Motion:
    """Join stands and walks into one motion that goes on from, ends in, or comes round to what is asked for."""
    motion, missing = join_pieces(pieces, inbetweener, settings)
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


def _join_ledgers(ledgers) -> Ledger:
    whole = Ledger()
    for ledger in ledgers:
        whole = whole.join(ledger)
    return whole
