"""Keys of a shot that tell a pose, where the hips are, or which way they face: met on the way, by the in-betweener."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.inbetweening.pipeline import fill
from controllers.shots.request import Filling, Look, PoseKey, Reach, choose_filling
from controllers.shots.way import Way
from mapctl import kinematics, rotations
from mapctl.features import PRIOR_FPS, GroundPose
from mapctl.inbetweening.missing import MissingMask
from mapctl.inbetweening.partial_motion import mirror_quats
from mapctl.kinematics.placing import measure_look_angle, turn_head
from mapctl.motion import Motion
from mapctl.numerics.intervals import widen
from mapctl.pose import decode
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, TOES, Skeleton

_WIDTHS = (10, 16, 24, 36)  # frames on either side of a key that are tried
_MOST_WIDTH = 75
_TOLERANCE_SHARE = 0.95  # of a tolerance that is made use of
_MOST_EASINGS = 8
_HIPS_SPEED, _JOINT_SPEED, _TURN_RATE = 1.3, 2.0, 2.5  # m/s, m/s about the hips, rad/s: at most, on the way to a key


@dataclass(frozen=True, eq=False)
class MetPose:
    """A key and when and how it was met."""

    key: PoseKey
    """The key, at the time at which it was met."""
    wanted: Motion
    """One frame: the pose in its place as the key asks for it; what it does not tell is as it was found."""
    start: int
    """First frame of the key."""
    stop: int
    """One past its last frame."""

    @property
    def seconds(self) -> tuple[float, float]:
        """From when to when it is met, seconds since the shot's first frame."""
        return self.start / PRIOR_FPS, (self.stop - 1) / PRIOR_FPS


def meet_poses(
    motion: Motion, keys: Sequence[PoseKey], way: Way, inbetweener: Inbetweener
) -> tuple[Motion, tuple[MetPose, ...]]:
    """Change a shot's motion so that it meets the keys; how far around them, and when within the frames that a key
    allows, costs a viewer least."""
    met: list[MetPose] = []
    waiting = sorted(keys, key=lambda key: key.seconds)
    for number, key in enumerate(waiting):
        earliest = met[-1].stop if met else 0
        following = [_frame_of(other.seconds, motion) - other.within_frames for other in waiting[number + 1 :]]
        latest = min([motion.num_frames, *following])
        tried = list(_list_fillings(motion, key, way, earliest, latest))
        filling, chosen = tried[choose_filling([filling for filling, _ in tried], inbetweener)]
        if bool(filling.missing.frames.any()):
            motion = fill(filling.motion, filling.missing, inbetweener).motion
        else:
            motion = filling.motion
        met.append(chosen)
    return motion, tuple(met)


def measure_pose_error(motion: Motion, met: MetPose) -> tuple[float, float]:
    """Measure the largest distance of what a key tells from where it is to be, metres, and of the heading, degrees."""
    held = motion.slice(met.start, met.stop)
    away = (held.joint_positions() - met.wanted.joint_positions()).norm(dim=-1)
    counted = away if met.key.tells_body else away[:, :1]
    turned = _measure_turns(held, met.wanted)
    return float(counted.max()), float(torch.rad2deg(turned.max()))


def as_reaches(keys: Sequence[PoseKey], way: Way, found: Motion) -> tuple[Reach, ...]:
    """Return the keys of which only hands and feet count as reaches for where these are in the pose; `found` is any
    frame of the character."""
    reaches = []
    for key in keys:
        if key.joints:
            frame = min(round(key.seconds * PRIOR_FPS), len(way.arcs) - 1)
            positions = _place_pose(found, key, way, frame).joint_positions()[0]
            places = {name: tuple(positions[CANONICAL.index(name)].tolist()) for name in key.joints}
            reaches.append(Reach(key.seconds, places, key.hold_seconds, key.tolerance, key.within_frames))
    return tuple(reaches)


def pose_frames(met: Sequence[MetPose], frames: int) -> Bool[Tensor, " frames"]:
    """Mark the frames in which a whole pose is held."""
    held = torch.zeros(frames, dtype=torch.bool)
    for one in met:
        if one.key.tells_body:
            held[one.start : one.stop] = True
    return held


def _frame_of(seconds: float, motion: Motion) -> int:
    return min(round(seconds * PRIOR_FPS), motion.num_frames - 1)


def _list_fillings(
    motion: Motion, key: PoseKey, way: Way, earliest: int, latest: int
) -> Iterator[tuple[Filling, MetPose]]:
    """List what may be made anew around a key, by when it is met and how far around it."""
    shifts = {0, key.within_frames, -key.within_frames, key.within_frames // 2, -(key.within_frames // 2)}
    hold = round(key.hold_seconds * PRIOR_FPS) + 1
    for shift in sorted(shifts, key=abs):
        start = max(earliest, min(_frame_of(key.seconds, motion) + shift, latest - 1))
        stop = min(start + hold, latest)
        asked = _place_pose(motion.slice(start, start + 1), key, way, start)
        shown = _relax(asked, motion.slice(start, start + 1), key)
        least = _find_least_width(motion, shown, start)
        for width in sorted({min(_MOST_WIDTH, max(least, width)) for width in _WIDTHS}):
            found = _build_filling(
                motion, key, shown, (start, stop), (max(earliest, start - width), min(latest, stop + width))
            )
            yield found, MetPose(replace(key, seconds=start / PRIOR_FPS), asked, start, stop)


def _place_pose(found: Motion, key: PoseKey, way: Way, frame: int) -> Motion:
    """Return one frame as a key asks for it, what it does not tell as found; a pose without a place and a facing is on
    the way and along it."""
    pose = found if key.pose is None else key.pose
    root, quats = pose.root_position.double().clone(), pose.local_quat_xyzw.double().clone()
    arc = way.arcs[frame : frame + 1]
    if key.place is not None:
        root[0, ::2] = root.new_tensor(key.place)
    elif key.pose is not None:
        root[0, ::2] = way.curve.ground_point(arc)
    if key.height is not None:
        root[0, 1] = key.height
    angle = None
    if key.facing_deg is not None:
        angle = torch.deg2rad(root.new_tensor([key.facing_deg]))
    elif key.pose is not None:
        angle = way.curve.heading(arc).to(root)
    if angle is not None:
        turn = rotations.about_y(angle - kinematics.heading(quats[:, 0]))
        quats[:, 0] = rotations.multiply(turn, quats[:, 0])
    return replace(found, root_position=root, local_quat_xyzw=quats)


def _relax(asked: Motion, found: Motion, key: PoseKey) -> Motion:
    """Return a pose nearer to what the character does anyway, as far as the tolerance allows."""
    if key.most == 0:
        return asked
    allowed = key.most if key.tells_facing_alone else 100 * key.most
    share, eased = 1.0, found
    for _ in range(_MOST_EASINGS):
        eased = _blend(asked, found, share)
        off = _measure_off(eased, asked, key)
        if off <= allowed:
            break
        share *= _TOLERANCE_SHARE * allowed / off  # a slerp's joints stray from the chord
    return eased


def _blend(one: Motion, other: Motion, share: float) -> Motion:
    """Return one frame so far from one pose to another."""
    weight = torch.full((1, one.num_joints), share, dtype=torch.float64)
    quats = rotations.slerp(one.local_quat_xyzw, other.local_quat_xyzw.to(one.local_quat_xyzw), weight)
    root = torch.lerp(one.root_position, other.root_position.to(one.root_position), share)
    return replace(one, root_position=root, local_quat_xyzw=quats)


def _measure_off(pose: Motion, asked: Motion, key: PoseKey) -> float:
    """Measure how far off a pose is, centimetres, or degrees where only a facing is told."""
    if key.tells_facing_alone:
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
    # A shot's first and last frame stay, where no key tells them.
    missing[0] = missing[-1] = False
    mask = MissingMask.of_frames(missing, joints)
    mask = MissingMask(mask.joints.clone(), mask.root.clone())
    if key.tells_body:
        root[part], quats[part] = pose.root_position, pose.local_quat_xyzw
        mask.root[part], mask.joints[part] = False, False
    else:
        still = key.hold_seconds > 0 and key.place is not None
        travelled = root[part] - root[held[0] : held[0] + 1]
        root[part] = pose.root_position + (0.0 if still else 1.0) * travelled * root.new_tensor([1.0, 0.0, 1.0])
        quats[part, 0] = pose.local_quat_xyzw[:, 0]
        mask.root[part] = False
        if key.tells_facing:
            mask.joints[part, 0] = False
    changed = replace(motion, root_position=root, local_quat_xyzw=quats)
    return Filling(changed, mask, around)


_EASE_SECONDS = 0.5  # in which the head turns there, and back
_GLANCE_SHARE = 0.7  # of the way that the head goes toward what a hand reaches for: eyes do the rest
_EYES_LEAD_SECONDS, _APART_SECONDS = 0.25, 1.0


def turn_heads(motion: Motion, looks: Sequence[Look]) -> Motion:
    """Turn neck and head toward what is looked at, in half a second and back in another."""
    for look in looks:
        motion = turn_head(motion, _place(look), _ease(motion.num_frames, look))
    return motion


def look_where_hands_reach(motion: Motion, reaches: Sequence[Reach], looks: Sequence[Look], posed: Tensor) -> Motion:
    """Turn the head part of the way toward what hands reach for, as people do who see what they take; not within a
    second of what is looked at anyway, nor of frames that are `posed`."""
    busy = posed.clone()
    for look in looks:
        first, last = (round(second * PRIOR_FPS) for second in (look.seconds, look.seconds + look.hold_seconds))
        busy[max(0, first) : last + 1] = True
    busy = widen(busy, round(_APART_SECONDS * PRIOR_FPS))
    for reach in reaches:
        hands = [place for name, place in reach.places.items() if name.endswith("Hand")]
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
    return torch.rad2deg(measure_look_angle(motion, _place(look)))[held]


def _place(look: Look) -> Float[Tensor, "1 3"]:
    return torch.tensor([look.place], dtype=torch.float64)


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

    The trunk and the arms are the mean, over both sides, of the density's initial states: people who walk carry their
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
