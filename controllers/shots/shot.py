"""A shot: several wishes that hold at once.

Two levels. The density walks (a receding horizon of MAP windows along a way that is clear of obstacles and others, near
enough to what is reached for), and the in-betweener makes what no density does while it walks: the first and the last
step, and trunk and limbs that reach, with the MAP stage of all in-betweening behind it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.character import Character
from controllers.following.follow import FollowSettings
from controllers.inbetweening.pipeline import fill
from controllers.shots.clip_ends import arrive, go_on
from controllers.shots.joining import JoinSettings, Piece, join_pieces
from controllers.shots.keys.looking import look_where_hands_reach, turn_heads
from controllers.shots.keys.posing import MetPose, as_reaches, meet_poses, pose_frames
from controllers.shots.keys.reaching import ReachTargets, check_reaches, go_down, lean_way, settle_reaches
from controllers.shots.request import Reach, ShotRequest
from controllers.shots.rest_pose import build_rest_pose
from controllers.shots.transitions import Filling, choose_filling
from controllers.shots.walking import walk_pieces
from controllers.shots.way import Way, plan_way
from controllers.shots.wishes import Wish, check_wishes, describe_fights
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.problem.ledger import Ledger
from mapctl.problem.solution import Outcome, Solution, Status
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES, Skeleton

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
