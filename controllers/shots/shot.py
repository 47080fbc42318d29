"""A shot: several requests that hold at once; `follow` is a shot with nothing but a curve.

Two levels. The density walks (a receding horizon of MAP windows along a root trajectory that is clear of obstacles and
others, near enough to what is reached for), and the in-betweener generates what no density does while it walks: the
first and the last step, and trunk and limbs that reach, with the MAP stage of all in-betweening behind it.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from controllers.common.character import Character
from controllers.inbetweening.on_ground import meet_keys
from controllers.inbetweening.pipeline import fill
from controllers.shots.constraints import Constraint, check_keys, check_walk, describe_conflicts
from controllers.shots.footsteps import Footstep, find_footsteps
from controllers.shots.reaching import (
    MetPose,
    ReachTargets,
    as_reaches,
    bend_toward_keys,
    build_rest_pose,
    check_reaches,
    go_down,
    look_where_hands_reach,
    meet_poses,
    pose_frames,
    settle_reaches,
    turn_heads,
)
from controllers.shots.request import Reach, ShotRequest
from controllers.shots.seams import OVERLAP, JoinedPieces, arrive, close_loop, fill_frames, go_on, join_pieces
from controllers.shots.stairs import Stairs
from controllers.shots.trajectory import Trajectory, plan_trajectory
from controllers.shots.uneven import Footing, SteppedMotion, step_onto_ground
from controllers.shots.walk import FollowSettings, check_path, check_tracking, slows_in_corners, walk_spans
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.ground import Ground
from mapctl.intent.path import SpeedProfile, TimedSpeed, walk_at_ease
from mapctl.motion import Motion
from mapctl.problem.solution import Ledger, Solution, Status
from mapctl.protocols import Density, Inbetweener
from mapctl.retarget.legs import lower_by
from mapctl.runtime.stepwise import Progress
from mapctl.skeleton import CANONICAL, TOES, Skeleton
from mapctl.terms import Term


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ShotSolution(Solution):
    """A shot's motion and the residual of every constraint."""

    trajectory: Trajectory
    """The root trajectory that was planned."""
    constraints: tuple[Constraint, ...] = ()
    """Each constraint: asked, got, and the residual."""
    reaches: tuple[Reach, ...] = ()
    """Reaches at the times at which they were met, those of keys' hands and feet included."""
    met: tuple[MetPose, ...] = ()
    """Keys of poses, positions and facings, as they were met."""
    footing: Footing | None = None
    """How feet stand and swing on a ground that is not flat."""
    footsteps: tuple[Footstep, ...] = ()
    """Steps of the motion."""

    def details(self) -> dict:
        """Return the constraints, the footsteps, and how feet stand on a ground."""
        return {
            "constraints": [constraint.as_row() for constraint in self.constraints],
            "footsteps": [step.as_row() for step in self.footsteps],
            **({} if self.footing is None else {"footing": self.footing.as_row()}),
        }


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
    """Generate a motion in which all of the request holds, at PRIOR_FPS, on the canonical joints of `skeleton`.

    Where nothing but a walk is requested, no `inbetweener` is needed, and after `deadline_seconds` of wall clock, and
    at Ctrl-C, the solution so far is returned, with that status. `terms` are the caller's own, in every window of
    the walks; they see the character at its own size and the time since the first frame. On another `skeleton`
    strides are as long as its legs, and the toes' rest height is that of the settings' footing. Constraints that do
    not hold are named with numbers in the status, which is then infeasible.
    """
    if inbetweener is None and not request.walks_only:
        raise RequestError("standing, reversing, keys and clips need an in-betweener, and none is given")
    began, settings = time.perf_counter(), settings or FollowSettings()
    character = Character(skeleton, settings.footing.rest_height)
    limits = character.data_limits(prior.limits)
    stairs, planned = Stairs.find(request.curve, request.ground), request
    if stairs.treads and not isinstance(request.speed, TimedSpeed):
        speed = stairs.slow(request.speed or walk_at_ease(request.curve), request.curve, limits.slowest)
        planned = replace(request, speed=speed)
    trajectory = plan_trajectory(planned)
    if request.ground is not None:
        end = float(trajectory.arcs[-1])
        request = request.lower_clips(request.ground, character.toe_rest_height, trajectory.curve, end)
    rest = build_rest_pose(prior, skeleton, character.toe_rest_height)
    rise = _find_rise(request.ground, trajectory)
    level, poses = request.lower_targets(rise), tuple(key for key in request.poses if not key.joints)
    level = replace(level, reaches=(*level.reaches, *as_reaches(request.poses, trajectory, rest)), poses=poses)
    request = level.lower_targets(-rise)
    check_reaches(level.reaches, trajectory, rest)
    trajectory = bend_toward_keys(trajectory, level, rest)
    if slows_in_corners(request, trajectory.curve):
        settings = replace(settings, footing=replace(settings.footing, heels=None))
    reach = ReachTargets.of(level.reaches, len(trajectory.speeds) + (OVERLAP if request.loop else 0))
    pieces, walked, outcome = walk_spans(
        prior,
        request,
        trajectory.extend_loop(OVERLAP) if request.loop else trajectory,
        rest,
        character=character,
        settings=settings,
        generator=generator or torch.Generator().manual_seed(0),
        terms_of=lambda first, frames: (
            *terms,
            *reach.terms(skeleton, first, frames),
            *stairs.terms(trajectory, first, frames),
        ),
        progress=progress,
        deadline=None if deadline_seconds is None else time.monotonic() + deadline_seconds,
    )
    flat, stepped, reaches, met = pieces[0].motion, None, request.reaches, ()
    if inbetweener is not None:
        joined = join_pieces(pieces, trajectory, inbetweener, request.footsteps)
        flat = _finish_ends(joined, request, trajectory, inbetweener)
        flat, met = meet_poses(flat, request.poses, trajectory, inbetweener)
    motion, posed = flat, pose_frames(met, flat.num_frames)
    if request.ground is not None:
        clips = {0: request.lead, flat.num_frames - 1: request.arrival}
        ends = [frame for frame, clip in clips.items() if clip is not None]
        fixed = [*ends, *posed.nonzero()[:, 0].tolist(), *(step.land for step in request.footsteps)]
        stepped = step_onto_ground(flat, request.ground, character.toe_rest_height, keys=fixed)
        motion = _meet_clips(stepped, torch.tensor(ends)) if ends else stepped.motion
    if inbetweener is not None:  # which knows motion over a floor alone
        raised = (motion.root_position - flat.root_position)[:, 1]
        lowered, settled = _meet_targets(lower_by(motion, raised), request.lower_targets(raised), posed, inbetweener)
        motion = lower_by(lowered, -raised)
        reaches = tuple(replace(key, seconds=one.seconds) for key, one in zip(request.reaches, settled, strict=True))
    flat = motion if stepped is None else flat
    notes = [trajectory.note] if trajectory.note else []
    if request.walks_only:
        if request.speed is not None:
            notes += check_path(trajectory.curve, trajectory.arcs, limits)
        notes += check_tracking(flat, trajectory.curve)
    trajectory = trajectory.slice(motion.num_frames)
    found = replace(request, reaches=reaches)
    constraints = (*check_walk(found, trajectory, flat), *check_keys(found, motion, met, flat))
    notes += describe_conflicts(constraints, trajectory, motion)
    footing, footsteps = None, find_footsteps(flat)
    if stepped is not None:
        footing, footsteps = replace(stepped, motion=motion).measure_footing(), stepped.footsteps
        notes += footing.notes
    return ShotSolution(
        motion,
        Status(outcome).with_notes(notes, infeasible=bool(notes)),
        character.ledger(reduce(Ledger.join, (done.ledger for done in walked), Ledger())),
        tuple(window for done in walked for window in done.windows),
        walked[0].features if request.walks_only else None,
        time.perf_counter() - began,
        trajectory=trajectory,
        constraints=constraints,
        reaches=reaches,
        met=met,
        footing=footing,
        footsteps=tuple(footsteps),
    )


def _find_rise(ground: Ground | None, trajectory: Trajectory) -> Float[Tensor, " frames"]:
    """Find how high the ground is along a trajectory, metres."""
    return (
        torch.zeros(len(trajectory.arcs))
        if ground is None
        else ground.height(trajectory.curve.ground_point(trajectory.arcs))
    )


def _finish_ends(
    joined: JoinedPieces, request: ShotRequest, trajectory: Trajectory, inbetweener: Inbetweener
) -> Motion:
    """Generate the missing frames, and let the motion continue from, end in, or come round to what is requested."""
    motion, missing = joined.motion, joined.missing
    if request.lead is not None:
        motion = go_on(motion, missing, request.lead, inbetweener)
    elif bool(missing.any()):
        motion = fill_frames(motion, missing, inbetweener)
    motion = joined.settle(motion)
    if request.loop:
        motion = close_loop(motion, len(trajectory.speeds), inbetweener)
    if request.arrival is not None:
        motion = arrive(motion, request.arrival.bring_to(trajectory.curve, float(trajectory.arcs[-1])), inbetweener)
    return motion


def _meet_clips(stepped: SteppedMotion, ends: Int[Tensor, " ends"]) -> Motion:
    """Return a motion on ground, brought to its poses over level ground in the frames in which clips end and begin."""
    rise = stepped.ground.height(stepped.flat.joint_positions()[:, CANONICAL.index(TOES[0]), ::2])
    return meet_keys(stepped, stepped.motion, lower_by(stepped.flat, -rise), ends)


def _meet_targets(
    motion: Motion, request: ShotRequest, posed: Bool[Tensor, " frames"], inbetweener: Inbetweener
) -> tuple[Motion, tuple[Reach, ...]]:
    """Let a motion, some of whose frames are posed, meet reaches, then looks; also return the reaches as they were
    met."""
    reaches = settle_reaches(request.reaches, motion)
    motion = go_down(motion, reaches, posed)
    if reaches:
        reach = ReachTargets.of(reaches, len(posed)).relaxed(motion).within_reach(motion)
        free = reach.free_limbs(motion.num_joints, posed)
        motion = fill(motion, free, inbetweener, targets=reach.led_there(motion).targets).motion
    motion = look_where_hands_reach(motion, reaches, request.looks, posed)
    return turn_heads(motion, request.looks), reaches


def follow(
    prior: Density,
    curve: Curve,
    *,
    seconds: float | None = None,
    speed: float | SpeedProfile | None = None,
    ground: Ground | None = None,
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
    the curve is walked once. On a `ground` that is not flat feet stand on its levels and slopes. An `inbetweener` is
    needed where the curve reverses. See `solve_shot` for the rest. RequestError for requests that make no sense;
    infeasible ones are named with numbers in the status.
    """
    profile = SpeedProfile.constant(speed) if isinstance(speed, float | int) else speed
    return solve_shot(
        prior,
        inbetweener,
        ShotRequest(curve, profile, seconds, ground=ground),
        generator=generator,
        settings=settings,
        skeleton=skeleton,
        terms=terms,
        progress=progress,
        deadline_seconds=deadline_seconds,
    )
