"""What became of the wishes of a shot: asked, got, and the residual of each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from controllers.shots.keys.looking import measure_look_errors
from controllers.shots.keys.posing import MetPose, measure_pose_error
from controllers.shots.keys.reaching import STRETCHED_SHARE, ReachTargets
from controllers.shots.request import Look, PoseKey, Reach, ShotRequest
from controllers.shots.way import Way
from mapctl.curves.obstacles import measure_clearance
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import compute_target_errors
from mapctl.motion import Motion
from mapctl.numerics import vectors
from mapctl.skeleton import LIMBS

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
    found = [_check_path(way, hips, away), _check_progress(way, hips, away)]
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
        apart = 100 * float(vectors.length(hips[None] - there).amin())
        asked = f"{request.others.distance:g} m"
        found.append(Wish("keep apart", asked, apart, 100 * request.others.distance - 1.0, "cm", at_least=True))
    still, last = 100 * vectors.length(torch.diff(hips, dim=0)) * PRIOR_FPS, (motion.num_frames - 1) / PRIOR_FPS
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
    sentences, offsets = [], _measure_offsets(way, motion.root_position[:, ::2])
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
        lacking = torch.maximum(lacking, vectors.length(away) - STRETCHED_SHARE * limb.length(motion.skeleton))
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
    behind = vectors.length(hips - way.curve.ground_point(way.arcs))[away]
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
    """Measure the distance of the hips to the way by frame, metres."""
    near = way.wished.nearest(hips, way.wished_arcs)
    return vectors.length(hips - way.wished.ground_point(near))
