"""Constraints of a shot measured on its motion: asked, got and residual of each, and conflicts among those that do
not hold."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.shots.footsteps import SIDES
from controllers.shots.reaching import STRETCHED_SHARE, MetPose, ReachTargets, measure_look_errors, measure_pose_error
from controllers.shots.request import Look, PoseKey, Reach, ShotRequest
from controllers.shots.trajectory import Trajectory
from controllers.shots.walk import MOST_ACCELERATION
from mapctl import contacts
from mapctl.curves.obstacles import measure_clearance
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import compute_target_errors
from mapctl.metrics.body import measure_accelerations, measure_worst
from mapctl.metrics.gait import RUN_FLIGHT, find_gait, measure_flight
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, FEET, LIMBS, TOES

_PATH_CM, _PROGRESS_CM, _REACH_CM, _POSE_CM = 15.0, 50.0, 1.0, 0.1
_FACING_DEG, _LOOK_DEG, _STILL_CM_S, _FOOTHOLD_CM = 0.1, 15.0, 6.0, 5.0
# Captured walks, runs and gestures stay within these (`mapctl measure FOLDER`, the column of the largest).
_GLIDE_CM, _GLIDE_RUNNING_CM, _RUNNING = 4.0, 15.0, 2.0  # of a walk, and from this speed on, m/s
_SLIDE_CM, _DEPTH_CM, _UNSUPPORTED = 5.0, 1.0, 0.3  # of a planted toe; of any toe; seconds
_SEAM_RATIO = 1.2  # of a loop's largest step from one frame to the next
_NEAR_KEY_SECONDS = 1.0
_ASIDE = 0.05  # metres beside the curve, from which on a trajectory is bent toward a reach
_STILL_AT_START, _STILL_AT_END = 12, 24  # frames at PRIOR_FPS in which one is to stand, beginning and ending
_CONFLICT_FRAMES = 20  # before and after a constraint, in which others conflict with it


@dataclass(frozen=True)
class Constraint:
    """One constraint of a shot."""

    name: str
    """Name of the constraint, with its time."""
    asked: str
    """Requested value, in words and numbers."""
    got: float
    """Value reached, in `unit`."""
    limit: float
    """Value beyond which it does not hold, in `unit`."""
    unit: str
    """Unit of both."""
    at_least: bool = False
    """Whether `limit` is a least value; else a largest one."""
    remedy: str = ""
    """A change of the request with which it would hold; empty where it holds, or none is known."""
    seconds: tuple[float, float] | None = None
    """Start and end, seconds since the first frame; None is throughout."""

    @property
    def holds(self) -> bool:
        """Whether the constraint holds."""
        return self.got >= self.limit if self.at_least else self.got <= self.limit

    @property
    def residual(self) -> float:
        """By how much it does not hold, in `unit`; 0 where it does."""
        return max(0.0, self.limit - self.got if self.at_least else self.got - self.limit)

    def as_row(self) -> dict[str, Any]:
        """Return the row of a report."""
        names = ("asked", "got", "unit", "residual", "holds", "remedy", "seconds")
        return {"constraint": self.name, **{name: getattr(self, name) for name in names}}


def check_keys(request: ShotRequest, motion: Motion, met: Sequence[MetPose], flat: Motion) -> tuple[Constraint, ...]:
    """Measure what is reached for and looked at on a motion at PRIOR_FPS; poses as they were met over a flat floor."""
    found, positions = list[Constraint](), motion.joint_positions()
    for reach in request.reaches:
        targets = ReachTargets.of((reach,), motion.num_frames).targets
        miss = 100 * float(compute_target_errors(positions, targets).max())
        name = f"{', '.join(reach.positions)} at {round(reach.seconds, 2):g} s"
        limit = max(_REACH_CM, 100 * max(map(reach.tolerance_of, reach.positions)))
        remedy = _find_remedy(reach, motion) if miss > limit else ""
        found.append(Constraint(name, _held(reach), miss, limit, "cm", remedy=remedy, seconds=_span(reach)))
    found += [_check_pose(one, flat) for one in met]
    for look in request.looks:
        worst = float(measure_look_errors(motion, look).max())
        name = f"look at {round(look.seconds, 2):g} s"
        found.append(Constraint(name, "straight", worst, _LOOK_DEG, "degrees", seconds=_span(look)))
    return tuple(found)


def check_walk(request: ShotRequest, trajectory: Trajectory, motion: Motion) -> tuple[Constraint, ...]:
    """Measure the other constraints of a request on a motion at PRIOR_FPS over a flat floor."""
    positions = motion.joint_positions()
    hips = positions[:, 0, ::2]
    away = _find_frames_away(request, trajectory)
    off = _measure_offsets(trajectory, positions[:, 0])[away]
    behind = (hips - trajectory.curve.ground_point(trajectory.arcs)).norm(dim=-1)[away]
    found = [
        Constraint("path", "on the curve", 100 * float(off.mean()), _PATH_CM, "cm"),
        Constraint("progress", "on time", 100 * float(behind.max()), _PROGRESS_CM, "cm"),
    ]
    if request.loop:
        steps = torch.diff(torch.cat([positions, positions[:1]]), dim=0).norm(dim=-1).amax(dim=1) * PRIOR_FPS
        most = _SEAM_RATIO * float(steps[:-1].max())
        found.append(Constraint("loop", "last frame leads into the first", float(steps[-1]), most, "m/s"))
    for step in (step for step in request.footsteps if step.land < motion.num_frames):
        toe, side, at = CANONICAL.index(TOES[step.foot]), SIDES[step.foot], step.land / PRIOR_FPS
        miss = 100 * float((positions[step.land, toe, ::2] - positions.new_tensor(step.toe)).norm())
        found.append(
            Constraint(f"{side} foot at {at:.2f} s", "lands there", miss, _FOOTHOLD_CM, "cm", seconds=(at, at))
        )
    if request.obstacles:
        clear = 100 * float(measure_clearance(request.obstacles, positions[..., ::2]).amin())
        found.append(Constraint("obstacles", "no joint within", clear, 0.0, "cm", at_least=True))
    if request.others is not None and not request.others.courtesy:
        apart = 100 * float((hips[None] - request.others.at(torch.arange(len(hips)))).norm(dim=-1).amin())
        asked = f"{request.others.distance:g} m"
        found.append(Constraint("keep apart", asked, apart, 100 * request.others.distance - 1.0, "cm", at_least=True))
    if (gait := find_gait(request.labels)) is not None:
        flight = 100 * measure_flight(contacts.detect_contacts(positions[:, CANONICAL.indices(TOES)], PRIOR_FPS))
        asked, runs = ("no foot on the ground at times", True) if gait == "run" else ("a foot on the ground", False)
        found.append(Constraint(f"gait {gait}", asked, flight, 100 * RUN_FLIGHT, "% in flight", at_least=runs))
    speeds, last = 100 * torch.diff(hips, dim=0).norm(dim=-1) * PRIOR_FPS, (motion.num_frames - 1) / PRIOR_FPS
    ends = {"start": (request.stand_at_start, slice(_STILL_AT_START), (0.0, _STILL_AT_START / PRIOR_FPS))}
    ends["end"] = (request.stand_at_end, slice(-_STILL_AT_END, None), (last - _STILL_AT_END / PRIOR_FPS, last))
    for end, (stands, frames, seconds) in ends.items():
        if stands:
            moved = float(speeds[frames].mean())
            found.append(Constraint(f"stand at the {end}", "still", moved, _STILL_CM_S, "cm/s", seconds=seconds))
    return (*found, *_check_motion(positions))


def _check_motion(positions: Float[Tensor, "frames joints 3"]) -> list[Constraint]:
    """Measure what a viewer sees of any motion, in its worst frames."""
    if len(positions) < 3:
        return []
    worst = measure_worst(positions, 0, CANONICAL.indices(TOES), CANONICAL.indices(FEET), PRIOR_FPS)
    speed = float(positions[:, 0, ::2].diff(dim=0).norm(dim=-1).max()) * PRIOR_FPS
    glide = _GLIDE_CM if speed < _RUNNING else _GLIDE_RUNNING_CM
    slide = 0.0 if math.isnan(worst["slide_max_cm"]) else worst["slide_max_cm"]  # of feet that never stand
    at = (int(measure_accelerations(positions, PRIOR_FPS).argmax()) + 1) / PRIOR_FPS
    return [
        Constraint("feet", "a step for every displacement", worst["glide_cm"], glide, "cm"),
        Constraint("soles", "rest while they stand", slide, _SLIDE_CM, "cm"),
        Constraint("support", "a foot on the ground, or flight", worst["unsupported_max_s"], _UNSUPPORTED, "s"),
        Constraint("ground", "no toe below", worst["depth_max_cm"], _DEPTH_CM, "cm"),
        Constraint("acceleration", f"at {at:.2f} s", worst["acceleration_max_m_s2"], MOST_ACCELERATION, "m/s^2"),
    ]


def describe_conflicts(constraints: Sequence[Constraint], trajectory: Trajectory, motion: Motion) -> list[str]:
    """Describe every constraint that does not hold: by how much, which others do not hold at that time, and what would
    settle it."""
    sentences, offsets = [], _measure_offsets(trajectory, motion.root_position)
    for one in (constraint for constraint in constraints if not constraint.holds):
        rivals = [other for other in constraints if other is not one and not other.holds and _overlap(one, other)]
        against = [f"{other.name}, {other.residual:.1f} {other.unit} short" for other in rivals]
        if one.seconds is not None:
            first, last = (round(second * PRIOR_FPS) for second in one.seconds)
            near = offsets[max(0, first - _CONFLICT_FRAMES) : last + _CONFLICT_FRAMES]
            against.append(f"the path, {100 * float(near.max()):.0f} cm off at that time")
        short = f"{one.got:.1f} {one.unit}, {one.residual:.1f} {one.unit} short"
        remedy = f" ({one.remedy} would do)" if one.remedy else ""
        rest = f"; against {', '.join(against)}" if against else ""
        sentences.append(f"{one.name} ({one.asked}): {short}{remedy}{rest}")
    return sentences


def _overlap(one: Constraint, other: Constraint) -> bool:
    """Return whether two constraints are at one time."""
    if one.seconds is None or other.seconds is None:
        return True
    apart = _CONFLICT_FRAMES / PRIOR_FPS
    return one.seconds[0] - apart < other.seconds[1] and other.seconds[0] - apart < one.seconds[1]


def _span(key: Reach | Look | PoseKey) -> tuple[float, float]:
    return key.seconds, key.seconds + key.hold_seconds


def _held(key: Reach | PoseKey) -> str:
    return f"held {key.hold_seconds:g} s" if key.hold_seconds else "there"


def _check_pose(met: MetPose, motion: Motion) -> Constraint:
    """Measure by how much a key is missed."""
    metres, degrees = measure_pose_error(motion, met)
    key = met.key
    if key.gives_facing_alone:
        name = f"facing {key.facing_deg:g} degrees at {key.seconds:.2f} s"
        return Constraint(name, _held(key), degrees, max(_FACING_DEG, key.most), "degrees", seconds=_span(key))
    name = f"{'pose' if key.gives_body else 'hips'} at {key.seconds:.2f} s"
    return Constraint(name, _held(key), 100 * metres, max(_POSE_CM, 100 * key.most), "cm", seconds=_span(key))


def _find_remedy(reach: Reach, motion: Motion) -> str:
    """Find when the character comes within reach of the position, or by how much nearer it would have to be; nothing
    where it is within reach at the wanted time, and another constraint prevents it."""
    lacking = torch.zeros(motion.num_frames, dtype=torch.float64)
    for name, position in reach.positions.items():
        limb = LIMBS[name]
        away = motion.joint_positions()[:, limb.upper] - motion.root_position.new_tensor(position)
        lacking = torch.maximum(lacking, away.norm(dim=-1) - STRETCHED_SHARE * limb.length(motion.skeleton))
    wanted = reach.seconds * PRIOR_FPS
    within = (lacking <= 0).nonzero()[:, 0]
    if len(within):
        late = (float(within[(within - wanted).abs().argmin()]) - wanted) / PRIOR_FPS
        return f"{abs(late):.1f} s {'later' if late > 0 else 'earlier'}" if abs(late) >= 0.05 else ""
    return f"{100 * float(lacking.min()):.0f} cm nearer"


def _find_frames_away(request: ShotRequest, trajectory: Trajectory) -> Tensor:
    """Find the frames away from keys and from where the trajectory is bent; all where none is."""
    away = trajectory.aside < _ASIDE
    for key in (*request.reaches, *request.poses):
        first, last = _span(key)
        start = max(0, math.floor((first - _NEAR_KEY_SECONDS) * PRIOR_FPS))
        away[start : max(0, math.ceil((last + _NEAR_KEY_SECONDS) * PRIOR_FPS))] = False
    return away if bool(away.any()) else torch.ones_like(away)


def _measure_offsets(trajectory: Trajectory, hips: Tensor) -> Tensor:
    """Measure the distance of the hips to the unbent curve by frame, metres: over the ground, or in space if it is."""
    points = trajectory.unbent.to_curve_axes(hips)
    return (points - trajectory.unbent.point(trajectory.unbent.nearest(points, trajectory.unbent_arcs))).norm(dim=-1)
