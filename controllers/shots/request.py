"""Requests for shots: several wishes that hold at once."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import MotionStart, start_from_state
from controllers.common.map_refinement import estimate_rest_height
from controllers.inbetweening.pipeline import InfillSettings, fill
from mapctl import contacts, kinematics
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.inbetweening.missing import MissingMask
from mapctl.intent.keyframes import WorldPosition
from mapctl.intent.path import SpeedProfile, TimedSpeed, find_reversals
from mapctl.kinematics.moving import bring_curve_points, measure_travel, move_to, rotate_about_vertical
from mapctl.metrics import body
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.receding_horizon import replay
from mapctl.protocols import Density, Inbetweener
from mapctl.skeleton import CANONICAL, LIMBS, TOES

_CONTEXT = 16  # frames on either side that the in-betweener is shown
_ACCELERATION_WEIGHT = 0.003  # m/s for a m/s^2 of the worst hand or toe
_SKATE_WEIGHT = 0.5  # of skating toes beside sliding of the support
_DETOUR_WEIGHT = 0.5  # of the trajectory's excess length over the straight one, m/s for m/s
_UNSUPPORTED_WEIGHT = 0.5  # of the longest time on no planted foot, m/s for a second
_SKATE_HEIGHT = 0.025  # metres
_TOES = CANONICAL.indices(TOES)
_EFFECTORS = CANONICAL.indices(("leftHand", "rightHand", *TOES))


@dataclass(frozen=True)
class Transition:
    """Frames start to stop between two spans, which the in-betweener makes."""

    start: int
    """First frame."""
    stop: int
    """One past the last frame."""


@dataclass(frozen=True, eq=False)
class Filling:
    """A shot's motion of which a part is to be made anew."""

    motion: Motion
    """All frames of the shot."""
    missing: MissingMask
    """What is to be made."""
    around: tuple[int, int]
    """Frames start to stop that it is within."""


def measure_transition_cost(before: Motion, after: Motion, one: Transition, inbetweener: Inbetweener) -> float:
    """Measure what a viewer would mind of a transition from one motion to another, both of the whole shot's frames,
    m/s."""
    frame = torch.arange(before.num_frames)
    missing = MissingMask.of_frames((frame >= one.start) & (frame < one.stop), before.num_joints)
    return _measure_cost(Filling(join_across(before, after, one), missing, (one.start, one.stop)), inbetweener)


def choose_filling(candidates: Sequence[Filling], inbetweener: Inbetweener) -> int:
    """Choose the candidate that costs a viewer least. The in-betweener's proposals are compared, without
    MAP."""
    if len(candidates) == 1:
        return 0
    costs = [_measure_cost(one, inbetweener) for one in candidates]
    return costs.index(min(costs))


def _measure_cost(filling: Filling, inbetweener: Inbetweener) -> float:
    """Measure what a viewer would mind, m/s: sliding, skating, detours, time on no foot (see `compute_artefact_cost`),
    and the worst acceleration."""
    start, stop = filling.around
    first, last = max(0, start - _CONTEXT), min(filling.motion.num_frames, stop + _CONTEXT)
    gap = (max(1, start - first), min(stop, filling.motion.num_frames - 1) - first)
    part, missing = filling.motion.slice(first, last), filling.missing.slice(first, last)
    if not bool(missing.frames.any()):
        return 0.0
    done = fill(part, missing, inbetweener, settings=InfillSettings(finish=False))
    shown = done.motion.slice(max(0, gap[0] - 2), min(done.motion.num_frames, gap[1] + 2))
    peaks = body.measure_peaks(shown.joint_positions()[:, _EFFECTORS], shown.root_position, float(shown.fps))
    return compute_artefact_cost(done.motion, done.contacts, gap) + _ACCELERATION_WEIGHT * peaks.acceleration


def compute_artefact_cost(motion: Motion, planted: Bool[Tensor, "frames 2"], gap: tuple[int, int]) -> float:
    """Compute the cost of visible artefacts in a filled gap as a speed, m/s: sliding of the support, skating toes, a
    detour, the longest unsupported time.
    """
    start, stop = gap[0] - 1, gap[1] + 1
    positions, fps = motion.joint_positions()[start:stop], float(motion.fps)
    toes, hips = positions[:, _TOES], positions[:, 0]
    height = estimate_rest_height(motion, contacts.debounced(planted))[start:stop]
    above, speeds = (toes[..., 1] - height)[1:], torch.diff(toes[..., ::2], dim=0).norm(dim=-1) * fps
    slide = float(contacts.support_speed(above, speeds).mean())
    skate = float((speeds * (1 - above / _SKATE_HEIGHT).clamp(0, 1)).mean())
    ground = hips[:, ::2]
    detour = float(torch.diff(ground, dim=0).norm(dim=-1).sum()) - float((ground[-1] - ground[0]).norm())
    unsupported = body.measure_longest_unsupported(toes, hips, fps)
    return (
        slide
        + _SKATE_WEIGHT * skate
        + _DETOUR_WEIGHT * detour * fps / len(positions)
        + _UNSUPPORTED_WEIGHT * unsupported
    )


def join_across(before: Motion, after: Motion, transition: Transition) -> Motion:
    """Take frames before the transition from one motion, the others from another of as many frames."""
    earlier = torch.arange(before.num_frames) < transition.start
    return replace(
        before,
        root_position=torch.where(earlier[:, None], before.root_position, after.root_position),
        local_quat_xyzw=torch.where(earlier[:, None, None], before.local_quat_xyzw, after.local_quat_xyzw),
    )


_MEMORY_FRAMES = 120  # at PRIOR_FPS, that warm up the density's state
TRAVEL_FRAMES = 15
"""Frames at PRIOR_FPS over which a clip's direction of travel is measured."""
STANDING_SPEED = 0.3
"""m/s below which a clip stands, and its hips' heading is its direction."""
_ASIDE = math.radians(75.0)  # between the hips' heading and the direction of travel
_STILL_SPEED = 0.3  # m/s of a joint, above which it gestures
_PAST_FRAMES = 10  # of a clip, that are seen before a shot's first frame
_REST_FRAMES, _SOON = 24, 45  # frames in which limbs come to rest, or until the first step where it ends that soon


@dataclass(frozen=True, eq=False)
class Lead:
    """The frames of a clip up to the one that a shot begins in."""

    motion: Motion
    """On canonical joints with the character's bones, at PRIOR_FPS; the last frame is the shot's first."""

    @staticmethod
    def of(canonical: Motion, frame: int) -> "Lead":
        """Take the frames up to one of a clip, at its own rate; RequestError for a frame that it does not have, and
        for its first two, before which nothing shows how it moves."""
        if not 2 <= frame < canonical.num_frames:
            raise RequestError(f"the clip's frames to go on from are 2:{canonical.num_frames}, got {frame}")
        # Resampling keeps the first frame, so backwards it keeps the last.
        backwards = _reverse(canonical.slice(0, frame + 1)).resample(PRIOR_FPS)
        return Lead(_reverse(backwards.slice(0, min(backwards.num_frames, _MEMORY_FRAMES))))

    @property
    def last_pose(self) -> Motion:
        """Its last frame."""
        return self.motion.slice(self.motion.num_frames - 1, self.motion.num_frames)

    @property
    def past(self) -> Motion:
        """The frames before its last, as far as they say how it moves."""
        last = self.motion.num_frames - 1
        return replace(self.motion.slice(max(0, last - _PAST_FRAMES), last), moving_offsets={})

    @property
    def stands(self) -> bool:
        """Whether it ends standing, or going backwards or sideways, which no walk goes on from without a stop."""
        speed, direction = self._travel
        return speed < STANDING_SPEED or abs(math.remainder(direction - self._heading, math.tau)) > _ASIDE

    @property
    def gestures(self) -> bool:
        """Whether it ends standing while limbs move: they come to rest first."""
        end = self.motion.slice(max(0, self.motion.num_frames - 4), self.motion.num_frames).joint_positions()
        return self.stands and float(torch.diff(end, dim=0).norm(dim=-1).max()) * PRIOR_FPS > _STILL_SPEED

    @property
    def direction(self) -> float:
        """Direction of travel at its end, radians; the hips' heading of somebody who stands or does not go ahead."""
        return self._heading if self.stands else self._travel[1]

    @property
    def _heading(self) -> float:
        return float(kinematics.heading(self.motion.local_quat_xyzw[-1:, 0]))

    @property
    def _travel(self) -> tuple[float, float]:
        frames = self.motion.num_frames
        return measure_travel(self.motion.slice(max(0, frames - TRAVEL_FRAMES), frames))

    def bring_curve(self, curve: Curve) -> Curve:
        """Return a curve moved so that it begins at the lead's end and leads on."""
        angle = self.direction - curve.start_heading
        return replace(
            curve, points=bring_curve_points(curve.points, curve.points[0], angle, self.motion.root_position[-1, ::2])
        )

    def bring_to(self, curve: Curve) -> "Lead":
        """Return the lead moved so that it ends where a curve begins, on its way along it."""
        turned = rotate_about_vertical(self.motion, curve.start_heading - self.direction)
        return Lead(move_to(turned, curve.ground_point(0.0), frame=-1))

    def start(self, prior: Density, character: Character) -> MotionStart:
        """Return the density's state at its end, of the prior's size."""
        size = character.scale
        unit = replace(self.motion, skeleton=character.unit_skeleton, root_position=self.motion.root_position / size)
        features, place = encode(unit)
        ground, heading = integrate_root(features, place)
        observed = features.float()
        state = replay(prior, observed[1:], prior.start_after(observed[:1]))
        end = GroundPose(ground[-1].float(), heading[-1].float())
        return start_from_state(state, end, character.unit_skeleton)


def go_on(motion: Motion, missing: Bool[Tensor, " frames"], lead: Lead, inbetweener: Inbetweener) -> Motion:
    """Make the missing frames of a shot's motion; who gestures where the clip ends comes to rest on the way to the
    first step, told how the clip was moving."""
    if not lead.gestures:
        return fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    first = next(((start, stop) for _, start, stop in true_intervals(missing[:, None].clone())), None)
    rest = first[1] if first is not None and first[0] < _SOON else min(_REST_FRAMES, motion.num_frames - 1)
    missing = missing.clone()
    missing[1:rest] = True
    past = lead.past
    missing = torch.cat([missing.new_zeros(past.num_frames), missing])
    whole = fill(past.join(motion), MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    return whole.slice(past.num_frames, whole.num_frames)


def _reverse(motion: Motion) -> Motion:
    return replace(
        motion,
        root_position=motion.root_position.flip(0),
        local_quat_xyzw=motion.local_quat_xyzw.flip(0),
        moving_offsets={joint: values.flip(0) for joint, values in motion.moving_offsets.items()},
    )


_WIDTHS = (18, 26, 36, 50)  # frames before the end that are tried


@dataclass(frozen=True, eq=False)
class Arrival:
    """The frames of a clip from the one on that a shot ends in."""

    motion: Motion
    """On canonical joints with the character's bones, at PRIOR_FPS; the first frame is the shot's last."""

    @staticmethod
    def of(canonical: Motion, frame: int) -> "Arrival":
        """Take the frames from one of a clip on, at its own rate; RequestError for a frame that it does not have, and
        for its last two, after which nothing shows how it moves."""
        if not 0 <= frame < canonical.num_frames - 2:
            raise RequestError(f"the clip's frames to end in are 0:{canonical.num_frames - 2}, got {frame}")
        onward = canonical.slice(frame, canonical.num_frames).resample(PRIOR_FPS)
        return Arrival(onward.slice(0, min(onward.num_frames, TRAVEL_FRAMES)))

    @property
    def stands(self) -> bool:
        """Whether the clip stands there."""
        return measure_travel(self.motion)[0] < STANDING_SPEED

    @property
    def direction(self) -> float:
        """Direction of travel, radians; the hips' heading of somebody who stands."""
        if self.stands:
            return float(kinematics.heading(self.motion.local_quat_xyzw[:1, 0]))
        return measure_travel(self.motion)[1]

    def bring_curve(self, curve: Curve) -> Curve:
        """Return an open curve moved so that it leads to the arrival and ends there."""
        angle = self.direction - float(curve.heading(curve.length))
        place = self.motion.root_position[0, ::2]
        return replace(curve, points=bring_curve_points(curve.points, curve.points[-1], angle, place))

    def bring_to(self, curve: Curve, arc: float) -> "Arrival":
        """Return the arrival moved so that it is at an `arc` (metres) of a curve, on its way along it."""
        turned = rotate_about_vertical(self.motion, float(curve.heading(arc)) - self.direction)
        return Arrival(move_to(turned, curve.ground_point(arc)))


def arrive(motion: Motion, arrival: Arrival, inbetweener: Inbetweener) -> Motion:
    """Make the last steps of a shot's motion anew so that it ends in an arrival, which is in its place."""
    frames, more = motion.num_frames, arrival.motion.num_frames
    longer = replace(
        motion,
        root_position=torch.cat([motion.root_position[:-1], arrival.motion.root_position]),
        local_quat_xyzw=torch.cat([motion.local_quat_xyzw[:-1], arrival.motion.local_quat_xyzw]),
    )
    tried = []
    for width in _WIDTHS:
        missing = torch.zeros(frames - 1 + more, dtype=torch.bool)
        first = max(1, frames - 1 - width)
        missing[first : frames - 1] = True
        tried.append(Filling(longer, MissingMask.of_frames(missing, motion.num_joints), (first, frames - 1)))
    chosen = tried[choose_filling(tried, inbetweener)]
    return fill(chosen.motion, chosen.missing, inbetweener).motion.slice(0, frames)


_SAME_PLACE = 0.05  # metres


@dataclass(frozen=True)
class Reach:
    """Hands or feet at places, for a moment or held."""

    seconds: float
    """When, seconds since the first frame."""
    places: Mapping[str, WorldPosition]
    """Canonical hands and feet and where they are to be, world, metres."""
    hold_seconds: float = 0.0
    """For how long they stay there."""
    tolerance: float | Mapping[str, float] = 0.0
    """How far from there they may be, metres, of all or by limb; 0 is exact."""
    within_frames: int = 0
    """How many frames of PRIOR_FPS earlier or later it may be."""

    def tolerance_of(self, name: str) -> float:
        """Return how far from its place a hand or a foot may be, metres."""
        return self.tolerance.get(name, 0.0) if isinstance(self.tolerance, Mapping) else self.tolerance

    def __post_init__(self):
        unknown = [name for name in self.places if name not in LIMBS]
        if unknown or not self.places:
            raise RequestError(f"hands and feet that reach are {', '.join(LIMBS)}; got {', '.join(unknown) or 'none'}")


@dataclass(frozen=True)
class Look:
    """The head looks at a place for a while."""

    seconds: float
    """When, seconds since the first frame."""
    place: WorldPosition
    """What it looks at, world, metres."""
    hold_seconds: float = 0.0
    """For how long."""


@dataclass(frozen=True, eq=False)
class PoseKey:
    """A pose, or where the hips are or face, at a time or held; what is not told is found."""

    seconds: float
    """When, seconds since the first frame."""
    pose: Motion | None = None
    """One frame on canonical joints with the character's bones; None where only the hips are told."""
    place: tuple[float, float] | None = None
    """Hips over the ground, x and z, metres; on the way if not given."""
    height: float | None = None
    """Height of the hips, metres; the pose's if not given."""
    facing_deg: float | None = None
    """Heading of the hips, degrees from +Z toward +X; that of a pose is along the way if not given."""
    joints: tuple[str, ...] = ()
    """Canonical hands and feet whose positions in the pose are all that counts."""
    root_only: bool = False
    """Whether only position and rotation of the pose's hips count."""
    hold_seconds: float = 0.0
    """For how long."""
    tolerance: float | Mapping[str, float] = 0.0
    """How far any joint may be from there, metres, of all or, where only `joints` count, by joint; degrees of a key
    that tells no more than a facing; 0 is exact."""
    within_frames: int = 0
    """How many frames of PRIOR_FPS earlier or later it may be."""

    def __post_init__(self):
        if self.pose is None and self.place is None and self.height is None and self.facing_deg is None:
            raise RequestError(f"the key at {self.seconds:g} s tells nothing")
        if isinstance(self.tolerance, Mapping) and not self.joints:
            raise RequestError(
                f"the key at {self.seconds:g} s tells more than hands and feet: its tolerance is one number"
            )

    @property
    def most(self) -> float:
        """How far anything may be from there, metres, or degrees of a facing alone: `tolerance`, or the largest of
        them."""
        return max(self.tolerance.values(), default=0.0) if isinstance(self.tolerance, Mapping) else self.tolerance

    @property
    def tells_body(self) -> bool:
        """Whether it tells more of a pose than its hips."""
        return self.pose is not None and not self.root_only

    @property
    def tells_facing(self) -> bool:
        """Whether it tells the hips' rotation."""
        return self.pose is not None or self.facing_deg is not None

    @property
    def tells_facing_alone(self) -> bool:
        """Whether it tells a facing and nothing else."""
        return self.pose is None and self.place is None and self.height is None


@dataclass(frozen=True, eq=False)
class Others:
    """Others who move, and how far to stay away from them."""

    hips: Float[Tensor, "others frames 2"]
    """Their hips on the ground from this shot's first frame on, at PRIOR_FPS, x and z, metres; the last frame holds."""
    distance: float
    """Least distance of hips, metres."""
    courtesy: bool = False
    """Whether they are only given room: they come later, and keep the distance themselves."""


@dataclass(frozen=True, eq=False)
class ShotRequest:
    """What one character is asked to do."""

    curve: Curve
    """Curve to walk, world, metres."""
    speed: SpeedProfile | TimedSpeed | None = None
    """Speed along it; None is USUAL_SPEED, and less in corners that turn faster than people who walk do."""
    seconds: float | None = None
    """Duration, seconds; None walks the curve once."""
    lead: Lead | None = None
    """A clip to go on from, which ends where the curve begins; None begins anew."""
    stand_at_start: bool = False
    """Whether it begins standing at ease; if not it begins in its stride."""
    stand_at_end: bool = False
    """Whether it ends standing at ease."""
    arrival: Arrival | None = None
    """A clip to end in, which begins where the curve ends; None ends by itself."""
    loop: bool = False
    """Whether the last frame leads into the first: once around a closed curve."""
    reaches: tuple[Reach, ...] = ()
    """Places for hands and feet."""
    looks: tuple[Look, ...] = ()
    """Places to look at."""
    poses: tuple[PoseKey, ...] = ()
    """Poses, places and headings of the hips."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles to walk around."""
    others: Others | None = None
    """Others to keep apart from."""

    @property
    def _start(self) -> Float[Tensor, "2"]:
        return self.curve.ground_point(0.0)

    @cached_property
    def walks_only(self) -> bool:
        """Whether it is nothing but a walk along the curve, in its stride, which needs no in-betweener."""
        ends = self.begins_standing or self.ends_standing or self.lead or self.arrival or self.loop
        more = self._named_keys or self.obstacles or self.others or isinstance(self.speed, TimedSpeed)
        return not (ends or more) and (self.curve.closed or not find_reversals(self.curve))

    @property
    def begins_standing(self) -> bool:
        """Whether it begins standing: at ease, or as the clip does that it goes on from."""
        return self.stand_at_start or (self.lead is not None and self.lead.stands)

    @property
    def ends_standing(self) -> bool:
        """Whether it ends standing: at ease, or as the clip does that it ends in."""
        return self.stand_at_end or (self.arrival is not None and self.arrival.stands)

    @property
    def _named_keys(self) -> list[tuple[str, Reach | Look | PoseKey]]:
        kinds = {"reach": self.reaches, "look": self.looks, "pose": self.poses}
        return [(what, key) for what, keys in kinds.items() for key in keys]

    def __post_init__(self):
        if self.seconds is None and isinstance(self.speed, TimedSpeed):
            raise RequestError("speeds by time need the shot's seconds")
        if self.lead is not None and self.stand_at_start:
            raise RequestError("a shot goes on from a clip or begins standing, not both")
        if self.arrival is not None and self.stand_at_end:
            raise RequestError("a shot ends in a clip or standing, not both")
        self._check_loop()
        for what, key in self._named_keys:
            if self.seconds is not None and not 0 <= key.seconds <= self.seconds - key.hold_seconds:
                raise RequestError(
                    f"a {what} from {key.seconds:g} s to {key.seconds + key.hold_seconds:g} s is not within "
                    f"the shot's {self.seconds:g} s"
                )
        for one, other in combinations(self.reaches, 2):
            _check_contradiction(one, other)
        for one, other in combinations(self.poses, 2):
            _check_poses_apart(one, other)
        self._check_places()
        inside = [obstacle for obstacle in self.obstacles if float(obstacle.distance(self._start)) < 0]
        if inside:
            raise RequestError(f"the obstacle at {inside[0].place[0]:g}, {inside[0].place[1]:g} stands on the start")

    def _check_places(self) -> None:
        told = [(key.seconds, place[0], place[2]) for key in self.reaches for place in key.places.values()]
        told += [(key.seconds, *key.place) for key in self.poses if key.place is not None]
        for obstacle in self.obstacles:
            for seconds, x, z in told:
                if float(obstacle.distance(torch.tensor([x, z], dtype=torch.float64))) < 0:
                    raise RequestError(
                        f"the key at {seconds:g} s is at {x:g}, {z:g}, within the obstacle at "
                        f"{obstacle.place[0]:g}, {obstacle.place[1]:g}"
                    )

    def _check_loop(self) -> None:
        if not self.loop:
            return
        if not self.curve.closed:
            raise RequestError("a loop needs a closed curve, and this one is open")
        ends = self.begins_standing or self.ends_standing or self.lead is not None or self.arrival is not None
        if ends or self.seconds is not None or isinstance(self.speed, TimedSpeed):
            raise RequestError(
                "a loop is walked once around, in its stride: without start, end, seconds, speeds by time"
            )


def _check_poses_apart(one: PoseKey, other: PoseKey) -> None:
    """Raise RequestError for two poses within two frames."""
    first, second = sorted((one, other), key=lambda key: key.seconds)
    if second.seconds - first.seconds - first.hold_seconds <= 2 / PRIOR_FPS:
        raise RequestError(
            f"two poses are to be held within two frames, from {first.seconds:g} s on and at {second.seconds:g} s"
        )


def _check_contradiction(one: Reach, other: Reach) -> None:
    """Raise RequestError for a limb that is to be at two places within two frames."""
    first, second = sorted((one, other), key=lambda reach: reach.seconds)
    if second.seconds - first.seconds - first.hold_seconds > 2 / PRIOR_FPS:
        return
    for name in first.places.keys() & second.places.keys():
        apart = math.dist(first.places[name], second.places[name])
        if apart > _SAME_PLACE:
            raise RequestError(
                f"{name} is to be at two places {100 * apart:.0f} cm apart within two frames, at {first.seconds:g} s "
                f"and at {second.seconds:g} s"
            )
