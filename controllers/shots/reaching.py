"""Targets of hands and feet that reach: a walk is led near them, trunk and limb are made anew around the moment."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.shots.request import Reach, ShotRequest
from controllers.shots.way import Way, bend_way
from mapctl import rotations
from mapctl.curves.obstacles import measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.missing import MissingMask
from mapctl.kinematics import inverse
from mapctl.kinematics.inverse import bend_within, find_out, lead_about
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals, widen
from mapctl.skeleton import CANONICAL, LIMBS, Skeleton
from mapctl.terms.keep_clear import WithinReach

AROUND_FRAMES = 27
"""Frames at PRIOR_FPS before and after a reach in which trunk and limb are free."""
EASY_SHARE = 0.9
"""Share of a stretched limb's length that it reaches without strain."""
STRETCHED_SHARE = 0.97
"""Share of its length that a limb is stretched toward what it cannot reach."""
_BENT_SHARE = 0.85  # of its length, from which on the way to a place is shortened
_LEAN = 0.05  # metres that leaning adds to what a limb reaches
_TOLERANCE_SHARE = 0.9  # of a tolerance that is made use of
_TRUNK = list(CANONICAL.indices(("spine", "chest", "neck", "head")))


@dataclass(frozen=True, eq=False)
class ReachTargets:
    """Targets of a shot by frame."""

    targets: EffectorTargets
    """World positions of hands and feet."""
    tolerances: Float[Tensor, "frames joints"]
    """How far from there they may be, metres."""

    @staticmethod
    def of(reaches: Sequence[Reach], frames: int) -> "ReachTargets":
        """Collect the targets of all reaches."""
        places = torch.zeros(frames, CANONICAL.num_joints, 3, dtype=torch.float64)
        wanted = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.bool)
        tolerances = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.float64)
        for reach in reaches:
            first = min(round(reach.seconds * PRIOR_FPS), frames - 1)
            held = slice(first, first + round(reach.hold_seconds * PRIOR_FPS) + 1)
            for name, place in reach.places.items():
                places[held, CANONICAL.index(name)] = places.new_tensor(place)
                wanted[held, CANONICAL.index(name)] = True
                tolerances[held, CANONICAL.index(name)] = reach.tolerance_of(name)
        return ReachTargets(EffectorTargets(places, wanted), tolerances)

    def relaxed(self, motion: Motion) -> "ReachTargets":
        """Return targets as much nearer to where limbs are anyway as their tolerances allow."""
        toward = motion.joint_positions() - self.targets.places
        far = toward.norm(dim=-1).clamp_min(1e-6)
        share = (_TOLERANCE_SHARE * self.tolerances / far).clamp(max=1.0)
        return self._at(self.targets.places + share[..., None] * toward)

    def terms(self, skeleton: Skeleton, first: int, frames: int) -> list[WithinReach]:
        """Build the terms that lead a walk near enough, for frames of the shot; lengths are of the skeleton's size."""
        found = []
        for name, limb in LIMBS.items():
            window = slice(first, first + frames)
            wanted = self.targets.wanted[window, limb.end]
            if not bool(wanted.any()):
                continue
            missing = frames - len(wanted)  # look-ahead beyond the shot's end
            place = torch.cat([self.targets.places[window, limb.end], torch.zeros(missing, 3, dtype=torch.float64)])
            wished = torch.cat([wanted, wanted.new_zeros(missing)])
            term = WithinReach(limb.upper, place, wished, EASY_SHARE * limb.length(skeleton))
            found.append(replace(term, name=f"{name} within reach"))
        return found

    def within_reach(self, motion: Motion) -> "ReachTargets":
        """Return the targets that limbs reach from where a motion comes; of a limb that reaches none of its targets,
        the nearest one, brought as near as the limb reaches."""
        places, wanted, positions = self.targets.places.clone(), self.targets.wanted.clone(), motion.joint_positions()
        for limb in LIMBS.values():
            away = places[:, limb.end] - positions[:, limb.upper]
            most = STRETCHED_SHARE * limb.length(motion.skeleton) + _LEAN
            far = away.norm(dim=-1)
            for _, first, last in true_intervals(wanted[:, limb.end : limb.end + 1].clone()):
                reached = far[first:last] <= most
                if not bool(reached.any()):
                    reached[far[first:last].argmin()] = True
                wanted[first:last, limb.end] = reached
            near = positions[:, limb.upper] + away * (most / far.clamp_min(1e-6)).clamp(max=1.0)[:, None]
            places[:, limb.end] = near
        return replace(self, targets=EffectorTargets(places, wanted))

    def led_there(self, motion: Motion) -> "ReachTargets":
        """Return targets in all frames around a reach: from where limbs are, smoothly to the place and back.

        Told of the place alone, an in-betweener that never saw such a reach goes there at the last moment. The way is
        about the shoulder, its direction and its distance by themselves: a straight one may lead through the body.
        """
        places, wanted, positions = self.targets.places.clone(), self.targets.wanted.clone(), motion.joint_positions()
        frame = torch.arange(len(wanted))
        for name, limb in LIMBS.items():
            reached, out = self.targets.wanted[:, limb.end], find_out(name, positions)
            shoulder = positions[:, limb.upper]
            bones = limb.length(motion.skeleton)
            way = positions[:, limb.end] - shoulder
            for _, first, last in true_intervals(reached[:, None].clone()):
                away = (first - frame).clamp_min(0) + (frame - last + 1).clamp_min(0)
                share = smootherstep((1 - away / (AROUND_FRAMES + 1)).to(way))
                aim = places[frame.clamp(first, last - 1), limb.end] - shoulder
                aim = bend_within(aim, bones, easy=_BENT_SHARE, most=STRETCHED_SHARE)
                way = torch.where(share[:, None] > 0, lead_about(way, aim, share, out=out), way)
            near = widen(reached, AROUND_FRAMES)
            places[:, limb.end] = torch.where(reached[:, None], places[:, limb.end], shoulder + way)
            wanted[:, limb.end] = near
        return replace(self, targets=EffectorTargets(places, wanted))

    def _at(self, places: Float[Tensor, "frames joints 3"]) -> "ReachTargets":
        return replace(self, targets=EffectorTargets(places, self.targets.wanted))

    def free_limbs(self, joints: int, posed: Bool[Tensor, " frames"]) -> MissingMask:
        """Return what the in-betweener makes anew: trunk and limb around every reach, but in `posed` frames."""
        frames = len(self.targets.wanted)
        free = torch.zeros(frames, joints, dtype=torch.bool)
        for name, limb in LIMBS.items():
            near = widen(self.targets.wanted[:, limb.end], AROUND_FRAMES)
            own = [CANONICAL.parents[limb.upper], limb.upper, limb.lower, limb.end]
            freed = own + _TRUNK if name.endswith("Hand") else own[1:]
            free[:, freed] |= (near & ~posed)[:, None]
        return MissingMask(free, torch.zeros(frames, dtype=torch.bool))


def settle_reaches(reaches: Sequence[Reach], motion: Motion) -> tuple[Reach, ...]:
    """Return reaches at the times, within the frames that each allows, at which their limbs are nearest to there."""
    positions, found = motion.joint_positions(), []
    for reach in reaches:
        if not reach.within_frames:
            found.append(reach)
            continue
        hold, at = round(reach.hold_seconds * PRIOR_FPS), round(reach.seconds * PRIOR_FPS)
        first = max(0, at - reach.within_frames)
        last = min(motion.num_frames - 1 - hold, at + reach.within_frames)
        away = torch.stack(
            [
                (positions[:, CANONICAL.index(name)] - positions.new_tensor(place)).norm(dim=-1)
                for name, place in reach.places.items()
            ]
        ).sum(dim=0)
        best = first + int(away[first : max(first, last) + 1].argmin())
        found.append(replace(reach, seconds=best / PRIOR_FPS))
    return tuple(found)


_TIPTOE, _CROUCH = 0.15, 1.0  # metres by which a body rises or goes down for a reach
_STEP_ASIDE = 1.2  # metres between the way and a body that leans and leaves it for a reach
_BEND_LENGTH, _BEND_STEP = 1.2, 0.05  # metres of arc over which the way bends toward a reach, and between its offsets
_LEAST_BEND, _USUAL_BEND, _MOST_BEND = 0.1, 0.5, 0.9
"""Metres aside: less the walk makes up for, more takes longer, more still is another way."""
_BEND_SHARES = (1.0, 0.7, 0.4)  # of a bend that are tried, where an obstacle is in the way of all of it
_STRAIGHT_AHEAD = 0.6  # of a limb's length that it reaches down beside whatever it reaches aside
_LEAST_CROUCH, _MOST_CROUCH, _POSED_FRAMES = 0.03, 0.3, 15  # metres down; frames beside a pose that is kept
_BODY = 0.25  # metres from the hips to an obstacle's edge


def check_reaches(reaches: Sequence[Reach], way: Way, rest: Motion) -> None:
    """Raise RequestError, with the distance, for targets beyond any arm or leg: too high over the ground, or too far
    from where the way is at that time for any lean or step aside."""
    positions = rest.joint_positions()[0]
    for reach in reaches:
        frame = min(round(reach.seconds * PRIOR_FPS), len(way.arcs) - 1)
        on_way = way.curve.ground_point(way.arcs[frame])
        for name, place in reach.places.items():
            limb = LIMBS[name]
            bones = limb.length(rest.skeleton)
            target = positions.new_tensor(place)
            up = float((target[1] - positions[limb.upper, 1]).abs())
            aside = float((target[::2] - on_way).norm())
            most = bones + (_TIPTOE if target[1] > positions[limb.upper, 1] else _CROUCH)
            if up > most or aside > bones + _STEP_ASIDE:
                raise RequestError(
                    f"{name} at {reach.seconds:g} s is to be {aside:.1f} m from where the way is then, and {up:.1f} m "
                    f"above or below the joint it reaches from; it is {bones:.2f} m long"
                )


def lean_way(way: Way, request: ShotRequest, rest: Motion) -> Way:
    """Return a way that is bent toward what is reached for where that is too far aside for an arm and a lean."""
    length = way.curve.length
    if not request.reaches or (way.curve.closed and float(way.arcs[-1]) > length):
        return way
    along = torch.linspace(0, length, max(2, round(length / _BEND_STEP) + 1), dtype=torch.float64)
    offsets, met = torch.zeros_like(along), []
    for reach in request.reaches:
        arc = way.arcs[min(round(reach.seconds * PRIOR_FPS), len(way.arcs) - 1)]
        for name, place in reach.places.items():
            aside = _find_lacking_aside(way, arc, rest, name, place)
            if abs(aside) > _LEAST_BEND:
                met.append(float(arc))
                reach_length = _BEND_LENGTH * max(1.0, abs(aside) / _USUAL_BEND)
                offsets += aside * smootherstep(1 - (along - arc).abs() / reach_length)
    offsets = offsets.clamp(-_STEP_ASIDE, _STEP_ASIDE) * smootherstep(along / (0.5 * _BEND_LENGTH))
    if bool((offsets.abs() < 1e-3).all()):
        return way
    # A closed curve is walked once at most here, and bent it is an open one.
    tried = (bend_way(way, share * offsets, met) for share in _BEND_SHARES)
    return next((bent for bent in tried if not _is_blocked(bent, request)), way)


def _find_lacking_aside(way: Way, arc: Tensor, rest: Motion, name: str, place: Sequence[float]) -> float:
    """Find how far to the left of the way one would have to be for a limb to reach a place, metres; 0 where it does."""
    limb, positions = LIMBS[name], rest.joint_positions()[0]
    bones = limb.length(rest.skeleton)
    target = way.curve.points.new_tensor(place)
    ground = target[::2] - way.curve.ground_point(arc)
    left, ahead = float(ground @ way.curve.left(arc)), float(ground @ way.curve.tangent(arc)[way.curve.ground_axes])
    beside = left - float(positions[limb.upper, 0])
    room = (EASY_SHARE * bones) ** 2 - ahead**2 - float(target[1] - positions[limb.upper, 1]) ** 2
    lacking = max(0.0, abs(beside) - math.sqrt(max(0.0, room)))
    return math.copysign(min(lacking, _MOST_BEND), beside)


def _is_blocked(way: Way, request: ShotRequest) -> bool:
    """Return whether a way leads through an obstacle."""
    places = way.curve.ground_point(way.arcs)
    return bool(request.obstacles) and float(measure_clearance(request.obstacles, places).amin()) < _BODY


def go_down(motion: Motion, reaches: Sequence[Reach], posed: Bool[Tensor, " frames"]) -> Motion:
    """Let the hips go down, and come up again, for what is too low to reach for upright; feet stay where they go.
    Nobody goes down within half a second of a frame that is `posed`."""
    down = torch.zeros(motion.num_frames, dtype=torch.float64)
    frame, near = torch.arange(motion.num_frames), widen(posed, _POSED_FRAMES)
    for reach in reaches:
        first = min(round(reach.seconds * PRIOR_FPS), motion.num_frames - 1)
        last = first + round(reach.hold_seconds * PRIOR_FPS)
        drop = min(_MOST_CROUCH, _find_lacking_below(motion, reach, first))
        if drop > _LEAST_CROUCH and not bool(near[first : last + 1].any()):
            away = (first - frame).clamp_min(0) + (frame - last).clamp_min(0)
            down = torch.maximum(down, drop * smootherstep(1 - away.double() / (AROUND_FRAMES + 1)))
    down = torch.where(near, 0.0, down)
    if not bool((down > 0).any()):
        return motion
    lowered = replace(motion, root_position=motion.root_position - down[:, None] * down.new_tensor([0.0, 1.0, 0.0]))
    return _keep_feet(lowered, motion)


def _find_lacking_below(motion: Motion, reach: Reach, frame: int) -> float:
    """Find how much lower the shoulders would have to be for hands to reach their places, metres."""
    positions, lacking = motion.joint_positions(), 0.0
    for name, place in reach.places.items():
        if not name.endswith("Hand"):
            continue
        limb = LIMBS[name]
        bones = limb.length(motion.skeleton)
        away = positions[frame, limb.upper] - positions.new_tensor(place)
        room = (EASY_SHARE * bones) ** 2 - float(away[::2].square().sum())
        lacking = max(lacking, float(away[1]) - math.sqrt(max(room, (_STRAIGHT_AHEAD * bones) ** 2)))
    return lacking


def _keep_feet(motion: Motion, before: Motion) -> Motion:
    """Bend legs so that feet are where they were before, and turned as they were; thighs turn as little as it takes."""
    quats = motion.local_quat_xyzw.clone()
    places, world, feet = motion.joint_positions(), motion.joint_rotations(), before.joint_positions()
    for name, limb in LIMBS.items():
        if name.endswith("Foot"):
            aim = feet[:, limb.end] - places[:, limb.upper]
            offsets = motion.skeleton.offsets.to(aim)
            turned, bent = inverse.reach(limb, world[:, limb.upper], quats[:, limb.lower], aim, offsets)
            above = world[:, CANONICAL.parents[limb.upper]]
            quats[:, limb.upper] = rotations.multiply(rotations.inverse(above), turned)
            quats[:, limb.lower] = bent
            shin = rotations.multiply(turned, bent)
            quats[:, limb.end] = rotations.multiply(rotations.inverse(shin), world[:, limb.end])
    return replace(motion, local_quat_xyzw=quats)
