"""Keys of a shot: targets that hands and feet reach, and poses, positions and headings that the walk meets.

A walk is led near the targets, and trunk and limb are solved anew around the moment; poses are met by the in-betweener.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.inbetweening.pipeline import fill
from controllers.shots.request import STANDING_SPEED, Look, PoseKey, Reach, ShotRequest
from controllers.shots.seams import Filling, choose_filling
from controllers.shots.trajectory import Trajectory, bend_trajectory
from mapctl import kinematics, rotations
from mapctl.curves.obstacles import measure_clearance
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.inbetweening.effector_targets import EffectorTargets
from mapctl.inbetweening.partial_motion import mirror_quats
from mapctl.kinematics.inverse import bend_within, find_out, lead_about
from mapctl.kinematics.moving import measure_look_angle, turn_head
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.numerics.intervals import true_intervals, widen
from mapctl.pose import decode
from mapctl.protocols import Density, Inbetweener
from mapctl.recording.masks import MissingMask
from mapctl.retarget.legs import bend_legs
from mapctl.skeleton import CANONICAL, FEET, LIMBS, TOES, Skeleton
from mapctl.terms import WithinReach

AROUND_FRAMES = 27
"""Frames at PRIOR_FPS before and after a reach in which trunk and limb are free."""
EASY_SHARE = 0.9
"""Share of a stretched limb's length that it reaches without strain."""
STRETCHED_SHARE = 0.97
"""Share of its length that a limb is stretched toward what it cannot reach."""
_BENT_SHARE = 0.85  # of its length, beyond which the path to a target is shortened
_LEAN = 0.05  # metres that leaning adds to what a limb reaches
_TOLERANCE_SHARE = 0.9  # of a tolerance that is used
_TRUNK = list(CANONICAL.indices(("spine", "chest", "neck", "head")))


@dataclass(frozen=True, eq=False)
class ReachTargets:
    """Targets of a shot by frame."""

    targets: EffectorTargets
    """World positions of hands and feet."""
    tolerances: Float[Tensor, "frames joints"]
    """Allowed distance from there, metres."""

    @staticmethod
    def of(reaches: Sequence[Reach], frames: int) -> "ReachTargets":
        """Collect the targets of all reaches."""
        goals = torch.zeros(frames, CANONICAL.num_joints, 3, dtype=torch.float64)
        wanted = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.bool)
        tolerances = torch.zeros(frames, CANONICAL.num_joints, dtype=torch.float64)
        for reach in reaches:
            first = min(round(reach.seconds * PRIOR_FPS), frames - 1)
            held = slice(first, first + round(reach.hold_seconds * PRIOR_FPS) + 1)
            for name, position in reach.positions.items():
                goals[held, CANONICAL.index(name)] = goals.new_tensor(position)
                wanted[held, CANONICAL.index(name)] = True
                tolerances[held, CANONICAL.index(name)] = reach.tolerance_of(name)
        return ReachTargets(EffectorTargets(goals, wanted), tolerances)

    def relaxed(self, motion: Motion) -> "ReachTargets":
        """Return targets as much nearer to where limbs are anyway as their tolerances allow."""
        toward = motion.joint_positions() - self.targets.positions
        far = toward.norm(dim=-1).clamp_min(1e-6)
        share = (_TOLERANCE_SHARE * self.tolerances / far).clamp(max=1.0)
        return replace(
            self, targets=replace(self.targets, positions=self.targets.positions + share[..., None] * toward)
        )

    def terms(self, skeleton: Skeleton, first: int, frames: int) -> list[WithinReach]:
        """Build the terms that lead a walk near enough, for frames of the shot; lengths are of the skeleton's size."""
        found = []
        for name, limb in LIMBS.items():
            window = slice(first, first + frames)
            wanted = self.targets.wanted[window, limb.end]
            if not bool(wanted.any()):
                continue
            missing = frames - len(wanted)  # look-ahead beyond the shot's end
            position = torch.cat(
                [self.targets.positions[window, limb.end], torch.zeros(missing, 3, dtype=torch.float64)]
            )
            sought = torch.cat([wanted, wanted.new_zeros(missing)])
            term = WithinReach(limb.upper, position, sought, EASY_SHARE * limb.length(skeleton))
            found.append(replace(term, name=f"{name} within reach"))
        return found

    def within_reach(self, motion: Motion) -> "ReachTargets":
        """Return the targets that limbs reach from where a motion comes; of a limb that reaches none of its targets,
        the nearest one, brought as near as the limb reaches."""
        goals, wanted, positions = self.targets.positions.clone(), self.targets.wanted.clone(), motion.joint_positions()
        for limb in LIMBS.values():
            away = goals[:, limb.end] - positions[:, limb.upper]
            most = STRETCHED_SHARE * limb.length(motion.skeleton) + _LEAN
            far = away.norm(dim=-1)
            for _, first, last in true_intervals(wanted[:, limb.end : limb.end + 1].clone()):
                reached = far[first:last] <= most
                if not bool(reached.any()):
                    reached[far[first:last].argmin()] = True
                wanted[first:last, limb.end] = reached
            near = positions[:, limb.upper] + away * (most / far.clamp_min(1e-6)).clamp(max=1.0)[:, None]
            goals[:, limb.end] = near
        return replace(self, targets=EffectorTargets(goals, wanted))

    def led_there(self, motion: Motion) -> "ReachTargets":
        """Return targets in all frames around a reach: from where limbs are, smoothly to the target and back, since an
        in-betweener given the target alone goes there at the last moment. Direction and distance from the shoulder
        change by themselves: a straight path may lead through the body."""
        goals, wanted, positions = self.targets.positions.clone(), self.targets.wanted.clone(), motion.joint_positions()
        frame = torch.arange(len(wanted))
        for name, limb in LIMBS.items():
            reached, out = self.targets.wanted[:, limb.end], find_out(name, positions)
            shoulder = positions[:, limb.upper]
            bones = limb.length(motion.skeleton)
            path = positions[:, limb.end] - shoulder
            for _, first, last in true_intervals(reached[:, None].clone()):
                away = (first - frame).clamp_min(0) + (frame - last + 1).clamp_min(0)
                share = smootherstep((1 - away / (AROUND_FRAMES + 1)).to(path))
                aim = goals[frame.clamp(first, last - 1), limb.end] - shoulder
                aim = bend_within(aim, bones, easy=_BENT_SHARE, most=STRETCHED_SHARE)
                path = torch.where(share[:, None] > 0, lead_about(path, aim, share, out=out), path)
            near = widen(reached, AROUND_FRAMES)
            goals[:, limb.end] = torch.where(reached[:, None], goals[:, limb.end], shoulder + path)
            wanted[:, limb.end] = near
        return replace(self, targets=EffectorTargets(goals, wanted))

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
    """Return reaches at the times, within the frames that each allows, at which their limbs are nearest to there, and
    are not stretched while they are held."""
    positions, found = motion.joint_positions(), []
    for reach in reaches:
        if not reach.within_frames:
            found.append(reach)
            continue
        hold, at = round(reach.hold_seconds * PRIOR_FPS), round(reach.seconds * PRIOR_FPS)
        first = max(0, at - reach.within_frames)
        last = min(motion.num_frames - 1 - hold, at + reach.within_frames)
        limbs = [CANONICAL.index(name) for name in reach.positions]
        away = (positions[:, limbs] - positions.new_tensor(list(reach.positions.values()))).norm(dim=-1).sum(dim=-1)
        stretched = torch.zeros_like(away)
        for name, position in reach.positions.items():
            limb = LIMBS[name]
            far = (positions[:, limb.upper] - positions.new_tensor(position)).norm(dim=-1)
            stretched += (far - EASY_SHARE * limb.length(motion.skeleton)).clamp_min(0)
        held = torch.stack([stretched.roll(-frame) for frame in range(hold + 1)]).amax(dim=0)
        best = first + int((away + _STRETCH_WEIGHT * held)[first : max(first, last) + 1].argmin())
        found.append(replace(reach, seconds=best / PRIOR_FPS))
    return tuple(found)


_STRETCH_WEIGHT = 10.0  # metres that a hand goes for a metre by which it is stretched
_TIPTOE, _CROUCH = 0.15, 1.0  # metres by which a body rises or goes down for a reach
_STEP_ASIDE = 1.2  # metres between the trajectory and a body that leans and leaves it for a reach
_BEND_LENGTH, _BEND_STEP = 1.2, 0.05  # metres of arc over which it bends toward a reach, and between its offsets
_LEAST_BEND, _USUAL_BEND, _MOST_BEND = 0.1, 0.5, 0.9
"""Metres aside: less is left to the walk, more takes longer, more still is another trajectory."""
_ARRIVED = 15  # frames after a walk in which its trajectory is bent toward a position
_BEND_SHARES = (1.0, 0.7, 0.4)  # of a bend that are tried, where an obstacle blocks all of it
_STRAIGHT_AHEAD = 0.6  # of a limb's length that it reaches down beside whatever it reaches aside
_LEAST_CROUCH, _MOST_CROUCH, _POSED_FRAMES = 0.03, 0.3, 15  # metres down; frames beside a pose that is kept
_BODY = 0.25  # metres from the hips to an obstacle's edge


def check_reaches(reaches: Sequence[Reach], trajectory: Trajectory, rest: Motion) -> None:
    """Raise RequestError, with the distance, for targets beyond any arm or leg: too high over the ground, or too far
    from where the trajectory is at that time for any lean or step aside."""
    positions = rest.joint_positions()[0]
    for reach in reaches:
        frame = min(round(reach.seconds * PRIOR_FPS), len(trajectory.arcs) - 1)
        on_path = trajectory.curve.ground_point(trajectory.arcs[frame])
        for name, position in reach.positions.items():
            limb = LIMBS[name]
            bones = limb.length(rest.skeleton)
            target = positions.new_tensor(position)
            up = float((target[1] - positions[limb.upper, 1]).abs())
            aside = float((target[::2] - on_path).norm())
            most = bones + (_TIPTOE if target[1] > positions[limb.upper, 1] else _CROUCH)
            if up > most or aside > bones + _STEP_ASIDE:
                raise RequestError(
                    f"{name} at {reach.seconds:g} s is to be {aside:.1f} m from where the walk is then, and {up:.1f} m "
                    f"above or below the joint it reaches from; it is {bones:.2f} m long"
                )


def bend_toward_keys(trajectory: Trajectory, request: ShotRequest, rest: Motion) -> Trajectory:
    """Return a trajectory bent toward what is reached for where that is too far aside for an arm and a lean, and toward
    positions of the hips that are passed in a walk."""
    length = trajectory.curve.length
    if trajectory.curve.closed and float(trajectory.arcs[-1]) > length:
        return trajectory
    asides = []
    for reach in request.reaches:
        arc = trajectory.arcs[min(round(reach.seconds * PRIOR_FPS), len(trajectory.arcs) - 1)]
        asides += [(arc, _find_lacking_aside(trajectory, arc, rest, *target)) for target in reach.positions.items()]
    for key in request.poses:
        frame = min(round(key.seconds * PRIOR_FPS), len(trajectory.arcs) - 1)
        if (
            key.place is not None
            and float(trajectory.speeds[max(0, frame - _ARRIVED) : frame + 1].max()) > STANDING_SPEED
        ):
            arc = trajectory.arcs[frame]
            ground = trajectory.arcs.new_tensor(key.place) - trajectory.curve.ground_point(arc)
            asides.append((arc, float(ground @ trajectory.curve.left(arc))))
    asides = [(arc, aside) for arc, aside in asides if abs(aside) > _LEAST_BEND]
    along = torch.linspace(0, length, max(2, round(length / _BEND_STEP) + 1), dtype=torch.float64)
    offsets = torch.zeros_like(along)
    for arc, aside in asides:
        reach_length = _BEND_LENGTH * max(1.0, abs(aside) / _USUAL_BEND)
        offsets += aside * smootherstep(1 - (along - arc).abs() / reach_length)
    offsets = offsets.clamp(-_STEP_ASIDE, _STEP_ASIDE) * smootherstep(along / (0.5 * _BEND_LENGTH))
    if bool((offsets.abs() < 1e-3).all()):
        return trajectory
    for share in _BEND_SHARES:  # a closed curve is walked once at most here, and bent it is an open one
        bent = bend_trajectory(trajectory, share * offsets, [float(arc) for arc, _ in asides])
        clear = measure_clearance(request.obstacles, bent.curve.ground_point(bent.arcs))
        if float(clear.amin()) >= _BODY:
            return bent
    return trajectory


def _find_lacking_aside(
    trajectory: Trajectory, arc: Tensor, rest: Motion, name: str, position: Sequence[float]
) -> float:
    """Find how far to the left of the trajectory a limb reaches a target, metres; 0 where it does anyway."""
    limb, positions = LIMBS[name], rest.joint_positions()[0]
    bones = limb.length(rest.skeleton)
    target = trajectory.curve.points.new_tensor(position)
    ground = target[::2] - trajectory.curve.ground_point(arc)
    left, ahead = (
        float(ground @ trajectory.curve.left(arc)),
        float(ground @ trajectory.curve.tangent(arc)[trajectory.curve.ground_axes]),
    )
    beside = left - float(positions[limb.upper, 0])
    room = (EASY_SHARE * bones) ** 2 - ahead**2 - float(target[1] - positions[limb.upper, 1]) ** 2
    lacking = max(0.0, abs(beside) - math.sqrt(max(0.0, room)))
    return math.copysign(min(lacking, _MOST_BEND), beside)


def go_down(motion: Motion, reaches: Sequence[Reach], posed: Bool[Tensor, " frames"]) -> Motion:
    """Let the hips go down, and come up again, for what is too low to reach for upright; feet stay where they go.
    The hips stay within half a second of a frame that is `posed`."""
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
    feet = list(CANONICAL.indices(FEET))
    return bend_legs(lowered, motion.joint_positions()[:, feet], motion.joint_rotations()[:, feet])


def _find_lacking_below(motion: Motion, reach: Reach, frame: int) -> float:
    """Find how much lower the shoulders would have to be for hands to reach their positions, metres."""
    positions, lacking = motion.joint_positions(), 0.0
    for name, position in reach.positions.items():
        if not name.endswith("Hand"):
            continue
        limb = LIMBS[name]
        bones = limb.length(motion.skeleton)
        away = positions[frame, limb.upper] - positions.new_tensor(position)
        room = (EASY_SHARE * bones) ** 2 - float(away[::2].square().sum())
        lacking = max(lacking, float(away[1]) - math.sqrt(max(room, (_STRAIGHT_AHEAD * bones) ** 2)))
    return lacking


_WIDTHS = (10, 16, 24, 36)  # frames on either side of a key that are tried
_MOST_WIDTH = 75
_MET_METRES, _MET_DEGREES = 5e-4, 0.05  # of a key that is met without a change
_POSE_TOLERANCE_SHARE = 0.95  # of a tolerance that is used
_MOST_EASINGS = 8
_HIPS_SPEED, _JOINT_SPEED, _TURN_RATE = 1.3, 2.0, 2.5  # m/s, m/s about the hips, rad/s: at most, towards a key


@dataclass(frozen=True, eq=False)
class MetPose:
    """A key and when and how it was met."""

    key: PoseKey
    """The key, at the time at which it was met."""
    wanted: Motion
    """One frame: the pose as the key asks for it; what it does not give is as it was found."""
    start: int
    """First frame of the key."""
    stop: int
    """One past its last frame."""

    @property
    def seconds(self) -> tuple[float, float]:
        """From when to when it is met, seconds since the shot's first frame."""
        return self.start / PRIOR_FPS, (self.stop - 1) / PRIOR_FPS


def meet_poses(
    motion: Motion, keys: Sequence[PoseKey], trajectory: Trajectory, inbetweener: Inbetweener
) -> tuple[Motion, tuple[MetPose, ...]]:
    """Change a shot's motion so that it meets the keys; how far around them, and when within the frames that a key
    allows, costs a viewer least."""
    met: list[MetPose] = []
    waiting = sorted(keys, key=lambda key: key.seconds)
    for number, key in enumerate(waiting):
        earliest = met[-1].stop if met else 0
        if (already := _find_met(motion, key, trajectory)) is not None:
            met.append(already)
            continue
        following = [_frame_of(other.seconds, motion) - other.within_frames for other in waiting[number + 1 :]]
        latest = min([motion.num_frames, *following])
        tried = list(_list_fillings(motion, key, trajectory, earliest, latest))
        filling, chosen = tried[choose_filling([filling for filling, _ in tried], inbetweener)]
        if bool(filling.missing.frames.any()):
            motion = fill(filling.motion, filling.missing, inbetweener).motion
        else:
            motion = filling.motion
        met.append(chosen)
    return motion, tuple(met)


def _find_met(motion: Motion, key: PoseKey, trajectory: Trajectory) -> MetPose | None:
    """Return a key as met where the motion meets it already; None where it does not."""
    start = _frame_of(key.seconds, motion)
    stop = min(motion.num_frames, start + round(key.hold_seconds * PRIOR_FPS) + 1)
    found = MetPose(key, trajectory.pose_at_key(motion.slice(start, start + 1), key, start), start, stop)
    metres, degrees = measure_pose_error(motion, found)
    return found if metres < _MET_METRES and (degrees < _MET_DEGREES or not key.gives_facing) else None


def measure_pose_error(motion: Motion, met: MetPose) -> tuple[float, float]:
    """Measure the largest distance of what a key gives from where it is to be, metres, and of the heading, degrees."""
    held = motion.slice(met.start, met.stop)
    away = held.joint_positions() - met.wanted.joint_positions()
    if not met.key.gives_body:
        away = away[:, :1]
    if met.key.pose is None and met.key.height is None:
        away = away[..., ::2]
    turned = _measure_turns(held, met.wanted)
    return float(away.norm(dim=-1).max()), float(torch.rad2deg(turned.max()))


def as_reaches(keys: Sequence[PoseKey], trajectory: Trajectory, found: Motion) -> tuple[Reach, ...]:
    """Return the keys of which only hands and feet count as reaches for where these are in the pose; `found` is any
    frame of the character."""
    reaches = []
    for key in keys:
        if key.joints:
            frame = min(round(key.seconds * PRIOR_FPS), len(trajectory.arcs) - 1)
            positions = trajectory.pose_at_key(found, key, frame).joint_positions()[0]
            goals = {name: tuple(positions[CANONICAL.index(name)].tolist()) for name in key.joints}
            reaches.append(Reach(key.seconds, goals, key.hold_seconds, key.tolerance, key.within_frames))
    return tuple(reaches)


def pose_frames(met: Sequence[MetPose], frames: int) -> Bool[Tensor, " frames"]:
    """Mark the frames in which a whole pose is held."""
    held = torch.zeros(frames, dtype=torch.bool)
    for one in met:
        if one.key.gives_body:
            held[one.start : one.stop] = True
    return held


def _frame_of(seconds: float, motion: Motion) -> int:
    return min(round(seconds * PRIOR_FPS), motion.num_frames - 1)


def _list_fillings(
    motion: Motion, key: PoseKey, trajectory: Trajectory, earliest: int, latest: int
) -> Iterator[tuple[Filling, MetPose]]:
    """List what may be generated around a key, by when it is met and how far around it."""
    shifts = {0, key.within_frames, -key.within_frames, key.within_frames // 2, -(key.within_frames // 2)}
    hold = round(key.hold_seconds * PRIOR_FPS) + 1
    for shift in sorted(shifts, key=abs):
        start = max(earliest, min(_frame_of(key.seconds, motion) + shift, latest - 1))
        stop = min(start + hold, latest)
        asked = trajectory.pose_at_key(motion.slice(start, start + 1), key, start)
        shown = _relax(asked, motion.slice(start, start + 1), key)
        least = _find_least_width(motion, shown, start)
        for width in sorted({min(_MOST_WIDTH, max(least, width)) for width in _WIDTHS}):
            found = _build_filling(
                motion, key, shown, (start, stop), (max(earliest, start - width), min(latest, stop + width))
            )
            yield found, MetPose(replace(key, seconds=start / PRIOR_FPS), asked, start, stop)


def _relax(asked: Motion, found: Motion, key: PoseKey) -> Motion:
    """Return a pose nearer to what the character does anyway, as far as the tolerance allows."""
    if key.most == 0:
        return asked
    allowed = key.most if key.gives_facing_alone else 100 * key.most
    share, eased = 1.0, found
    for _ in range(_MOST_EASINGS):
        eased = _blend(asked, found, share)
        off = _measure_off(eased, asked, key)
        if off <= allowed:
            break
        share *= _POSE_TOLERANCE_SHARE * allowed / off  # a slerp's joints stray from the chord
    return eased


def _blend(one: Motion, other: Motion, share: float) -> Motion:
    """Return one frame so far from one pose to another."""
    weight = torch.full((1, one.num_joints), share, dtype=torch.float64)
    quats = rotations.slerp(one.local_quat_xyzw, other.local_quat_xyzw.to(one.local_quat_xyzw), weight)
    root = torch.lerp(one.root_position, other.root_position.to(one.root_position), share)
    return replace(one, root_position=root, local_quat_xyzw=quats)


def _measure_off(pose: Motion, asked: Motion, key: PoseKey) -> float:
    """Measure how far off a pose is, centimetres, or degrees where only a facing is given."""
    if key.gives_facing_alone:
        return float(torch.rad2deg(_measure_turns(pose, asked))[0])
    return 100 * float((pose.joint_positions() - asked.joint_positions()).norm(dim=-1).max())


def _measure_turns(motion: Motion, other: Motion) -> Float[Tensor, " frames"]:
    """Measure by how much the headings of two motions' hips differ, radians; one of them may be one frame."""
    headings = [kinematics.heading(each.local_quat_xyzw[:, 0]) for each in (motion, other)]
    return rotations.wrap_angle(headings[0] - headings[1]).abs()


def _find_least_width(motion: Motion, pose: Motion, frame: int) -> int:
    """Find the fewest frames in which one gets to a pose without haste."""
    here = motion.slice(frame, frame + 1)
    moved = pose.joint_positions()[0] - here.joint_positions()[0]
    seconds = (
        float(moved[0].norm()) / _HIPS_SPEED,
        float((moved - moved[0]).norm(dim=-1).max()) / _JOINT_SPEED,
        float(_measure_turns(pose, here)) / _TURN_RATE,
    )
    return round(max(seconds) * PRIOR_FPS)


def _build_filling(
    motion: Motion, key: PoseKey, pose: Motion, held: tuple[int, int], around: tuple[int, int]
) -> Filling:
    frames, joints = motion.num_frames, motion.num_joints
    root, quats = motion.root_position.double().clone(), motion.local_quat_xyzw.double().clone()
    part = slice(*held)
    missing = torch.zeros(frames, dtype=torch.bool)
    missing[around[0] : around[1]] = True
    # A shot's first and last frame stay, where no key gives them.
    missing[0] = missing[-1] = False
    mask = MissingMask.of_frames(missing, joints)
    mask = MissingMask(mask.joints.clone(), mask.root.clone())
    if key.gives_body:
        root[part], quats[part] = pose.root_position, pose.local_quat_xyzw
        mask.root[part], mask.joints[part] = False, False
    else:
        still = key.hold_seconds > 0 and key.place is not None
        travelled = root[part] - root[held[0] : held[0] + 1]
        root[part] = pose.root_position + (0.0 if still else 1.0) * travelled * root.new_tensor([1.0, 0.0, 1.0])
        quats[part, 0] = pose.local_quat_xyzw[:, 0]
        mask.root[part] = False
        if key.gives_facing:
            mask.joints[part, 0] = False
    changed = replace(motion, root_position=root, local_quat_xyzw=quats)
    return Filling(changed, mask, around)


_EASE_SECONDS = 0.5  # in which the head turns there, and back
_GLANCE_SHARE = 0.7  # of the turn of the head toward what a hand reaches for: eyes do the rest
_EYES_LEAD_SECONDS, _APART_SECONDS = 0.25, 1.0


def turn_heads(motion: Motion, looks: Sequence[Look]) -> Motion:
    """Turn neck and head toward what is looked at, in half a second and back in another."""
    for look in looks:
        motion = turn_head(motion, _look_target(look), _ease(motion.num_frames, look))
    return motion


def look_where_hands_reach(motion: Motion, reaches: Sequence[Reach], looks: Sequence[Look], posed: Tensor) -> Motion:
    """Turn the head partly toward what hands reach for, as people look at what they take; not within a
    second of what is looked at anyway, nor of frames that are `posed`."""
    busy = posed.clone()
    for look in looks:
        first, last = (round(second * PRIOR_FPS) for second in (look.seconds, look.seconds + look.hold_seconds))
        busy[max(0, first) : last + 1] = True
    busy = widen(busy, round(_APART_SECONDS * PRIOR_FPS))
    for reach in reaches:
        hands = [position for name, position in reach.positions.items() if name.endswith("Hand")]
        first = max(0.0, reach.seconds - _EYES_LEAD_SECONDS)
        last = reach.seconds + reach.hold_seconds
        if not hands or bool(busy[round(first * PRIOR_FPS) : round(last * PRIOR_FPS) + 1].any()):
            continue
        middle = torch.tensor(hands, dtype=torch.float64).mean(dim=0)
        weight = _GLANCE_SHARE * _ease(motion.num_frames, Look(first, (0.0, 0.0, 0.0), last - first))
        motion = turn_head(motion, middle[None], weight)
    return motion


def measure_look_errors(motion: Motion, look: Look) -> Float[Tensor, " frames"]:
    """Measure the angle between where the head faces and what it is to look at, degrees, while it is to look."""
    first = round(look.seconds * PRIOR_FPS)
    held = slice(first, first + round(look.hold_seconds * PRIOR_FPS) + 1)
    return torch.rad2deg(measure_look_angle(motion, _look_target(look)))[held]


def _look_target(look: Look) -> Float[Tensor, "1 3"]:
    return torch.tensor([look.position], dtype=torch.float64)


def _ease(frames: int, look: Look) -> Float[Tensor, " frames"]:
    """Return how far the head is turned in each frame, 0 to 1."""
    seconds = torch.arange(frames, dtype=torch.float64) / PRIOR_FPS
    before = (look.seconds - seconds).clamp_min(0) + (seconds - look.seconds - look.hold_seconds).clamp_min(0)
    share = (1 - before / _EASE_SECONDS).clamp_min(0)
    return share * share * (3 - 2 * share)


_BEND_DEG = {"UpperLeg": -5.0, "LowerLeg": 10.0, "Foot": -5.0, "Toes": 0.0}
"""Bends of a leg that stands at ease, degrees about the lateral axis; the foot stays flat."""
_SPREAD_DEG = 3.0  # of each thigh sideways, undone at the foot


def build_rest_pose(density: Density, skeleton: Skeleton, toe_height: float) -> Motion:
    """Build one frame that stands at the origin and faces +Z, toes at `toe_height` metres.

    The trunk and the arms are the mean, over both sides, of the density's initial states: walking people carry their
    arms much as they do when they stand.
    """
    states = decode(density.initial_states.state.last_frame, GroundPose.origin(), skeleton=skeleton)
    quats = states.local_quat_xyzw.double()
    mean = rotations.average(torch.cat([quats, mirror_quats(quats)]))
    for side, outwards in (("left", 1.0), ("right", -1.0)):
        for part, bend in _BEND_DEG.items():
            spread = outwards * {"UpperLeg": _SPREAD_DEG, "Foot": -_SPREAD_DEG}.get(part, 0.0)
            angles = torch.deg2rad(torch.tensor([bend, 0.0, spread], dtype=torch.float64))
            mean[CANONICAL.index(side + part)] = rotations.from_rotation_vector(angles)
    mean[0] = mean.new_tensor([0.0, 0.0, 0.0, 1.0])
    pose = replace(states.slice(0, 1), root_position=torch.zeros(1, 3, dtype=torch.float64), local_quat_xyzw=mean[None])
    toes = pose.joint_positions()[0, list(skeleton.indices(TOES)), 1]
    return replace(pose, root_position=mean.new_tensor([[0.0, toe_height - float(toes.mean()), 0.0]]))
