"""Requests for shots: a curve, clips to begin from or end in, keys, and what to avoid."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import MotionStart, start_from_state
from controllers.shots.footsteps import Footstep
from mapctl import kinematics
from mapctl.curves import Curve
from mapctl.curves.obstacles import Obstacle
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.ground import Ground
from mapctl.intent.keyframes import WorldPosition
from mapctl.intent.path import SpeedProfile, TimedSpeed, find_reversals
from mapctl.kinematics.moving import bring_curve_points, measure_travel, move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.problem.receding_horizon import replay
from mapctl.protocols import Density
from mapctl.retarget.legs import lower_by
from mapctl.skeleton import CANONICAL, LIMBS, TOES

_MEMORY_FRAMES = 120  # at PRIOR_FPS, that warm up the density's state
TRAVEL_FRAMES = 15
"""Frames at PRIOR_FPS over which a clip's direction of travel is measured."""
STANDING_SPEED = 0.3
"""m/s below which a clip stands, and its hips' heading is its direction."""
_ASIDE = math.radians(75.0)  # between the hips' heading and the direction of travel
_STILL_SPEED = 0.3  # m/s of a joint, above which it gestures
_PAST_FRAMES = 10  # of a clip, before a shot's first frame
_SAME_POSITION = 0.05  # metres
_LOWEST_HIPS, _MOST_RISE = 0.3, 0.4  # metres of a curve in space: of a child's hips, and from a crouch to a stand
_LEVEL = 0.02  # metres by which the ground under both feet differs at most, to be level
_APART_SECONDS = 2 / PRIOR_FPS  # between keys that are to differ


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
            raise RequestError(f"the clip's frames to continue from are 2:{canonical.num_frames}, got {frame}")
        # Resampling keeps the first frame, so backwards it keeps the last.
        backwards = canonical.slice(0, frame + 1).reverse().resample(PRIOR_FPS)
        return Lead(backwards.slice(0, min(backwards.num_frames, _MEMORY_FRAMES)).reverse())

    @property
    def last_pose(self) -> Motion:
        """Its last frame."""
        return self._last(1)

    @property
    def past(self) -> Motion:
        """The frames shortly before its last."""
        last = self.motion.num_frames - 1
        return replace(self.motion.slice(max(0, last - _PAST_FRAMES), last), moving_offsets={})

    @property
    def stands(self) -> bool:
        """Whether it ends standing, or going backwards or sideways, from which no walk starts without a stop."""
        speed, direction = measure_travel(self._last(TRAVEL_FRAMES))
        return speed < STANDING_SPEED or abs(math.remainder(direction - self._heading, math.tau)) > _ASIDE

    @property
    def gestures(self) -> bool:
        """Whether it ends standing while limbs move: they come to rest first."""
        steps = torch.diff(self._last(4).joint_positions(), dim=0)
        return self.stands and float(steps.norm(dim=-1).max()) * PRIOR_FPS > _STILL_SPEED

    @property
    def direction(self) -> float:
        """Direction of travel at its end, radians; the hips' heading where it stands or does not go ahead."""
        return self._heading if self.stands else measure_travel(self._last(TRAVEL_FRAMES))[1]

    @property
    def _heading(self) -> float:
        return float(kinematics.heading(self.motion.local_quat_xyzw[-1:, 0]))

    def _last(self, frames: int) -> Motion:
        return self.motion.slice(max(0, self.motion.num_frames - frames), self.motion.num_frames)

    def bring_curve(self, curve: Curve) -> Curve:
        """Return a curve moved so that it begins at the lead's end and leads on."""
        angle, end = self.direction - curve.start_heading, self.motion.root_position[-1, ::2]
        return replace(curve, points=bring_curve_points(curve.points, curve.points[0], angle, end))

    def bring_to(self, curve: Curve) -> "Lead":
        """Return the lead moved so that it ends where a curve begins, in its direction."""
        turned = rotate_about_vertical(self.motion, curve.start_heading - self.direction)
        return Lead(move_to(turned, curve.ground_point(0.0), frame=-1))

    def start(self, prior: Density, character: Character) -> MotionStart:
        """Return the density's state at its end, of the prior's size."""
        root = self.motion.root_position / character.scale
        features, position = encode(replace(self.motion, skeleton=character.unit_skeleton, root_position=root))
        ground, heading = integrate_root(features, position)
        observed = features.float()
        state = replay(prior, observed[1:], prior.start_after(observed[:1]))
        return start_from_state(state, GroundPose(ground[-1].float(), heading[-1].float()), character.unit_skeleton)


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
        """Direction of travel, radians; the hips' heading where it stands."""
        if self.stands:
            return float(kinematics.heading(self.motion.local_quat_xyzw[:1, 0]))
        return measure_travel(self.motion)[1]

    def bring_curve(self, curve: Curve) -> Curve:
        """Return an open curve moved so that it leads to the arrival and ends there."""
        angle, end = self.direction - float(curve.heading(curve.length)), self.motion.root_position[0, ::2]
        return replace(curve, points=bring_curve_points(curve.points, curve.points[-1], angle, end))

    def bring_to(self, curve: Curve, arc: float) -> "Arrival":
        """Return the arrival moved so that it is at an `arc` (metres) of a curve, in its direction."""
        turned = rotate_about_vertical(self.motion, float(curve.heading(arc)) - self.direction)
        return Arrival(move_to(turned, curve.ground_point(arc)))


@dataclass(frozen=True)
class Reach:
    """Hands or feet at targets, for a moment or held."""

    seconds: float
    """When, seconds since the first frame."""
    positions: Mapping[str, WorldPosition]
    """Targets of canonical hands and feet, world, metres."""
    hold_seconds: float = 0.0
    """For how long."""
    tolerance: float | Mapping[str, float] = 0.0
    """Allowed distance from there, metres, of all or by limb; 0 is exact."""
    within_frames: int = 0
    """Frames of PRIOR_FPS earlier or later that are allowed."""

    def tolerance_of(self, name: str) -> float:
        """Return the allowed distance of a hand or a foot from its target, metres."""
        return self.tolerance.get(name, 0.0) if isinstance(self.tolerance, Mapping) else self.tolerance

    def __post_init__(self):
        unknown = [name for name in self.positions if name not in LIMBS]
        if unknown or not self.positions:
            raise RequestError(f"hands and feet that reach are {', '.join(LIMBS)}; got {', '.join(unknown) or 'none'}")


@dataclass(frozen=True)
class Look:
    """The head looks at a point for a while."""

    seconds: float
    """When, seconds since the first frame."""
    position: WorldPosition
    """Point that it looks at, world, metres."""
    hold_seconds: float = 0.0
    """For how long."""


@dataclass(frozen=True, eq=False)
class PoseKey:
    """A pose, or position or facing of the hips, at a time or held; what is not given is found."""

    seconds: float
    """When, seconds since the first frame."""
    pose: Motion | None = None
    """One frame on canonical joints with the character's bones; None where only the hips are given."""
    place: tuple[float, float] | None = None
    """Hips over the ground, x and z, metres; on the trajectory if not given."""
    height: float | None = None
    """Height of the hips over the ground, metres; the pose's if not given."""
    facing_deg: float | None = None
    """Heading of the hips, degrees from +Z toward +X; that of a pose is along the trajectory if not given."""
    joints: tuple[str, ...] = ()
    """Canonical hands and feet whose positions in the pose are all that counts."""
    root_only: bool = False
    """Whether only position and rotation of the pose's hips count."""
    hold_seconds: float = 0.0
    """For how long."""
    tolerance: float | Mapping[str, float] = 0.0
    """Allowed distance of any joint, metres, of all or, where only `joints` count, by joint; degrees of a key that
    gives a facing alone; 0 is exact."""
    within_frames: int = 0
    """Frames of PRIOR_FPS earlier or later that are allowed."""

    def __post_init__(self):
        if self.pose is None and self.place is None and self.height is None and self.facing_deg is None:
            raise RequestError(f"the key at {self.seconds:g} s gives nothing")
        if isinstance(self.tolerance, Mapping) and not self.joints:
            raise RequestError(
                f"the key at {self.seconds:g} s gives more than hands and feet: its tolerance is one number"
            )

    @property
    def most(self) -> float:
        """Largest allowed distance, metres, or angle of a facing alone, degrees."""
        return max(self.tolerance.values(), default=0.0) if isinstance(self.tolerance, Mapping) else self.tolerance

    @property
    def gives_body(self) -> bool:
        """Whether it gives more of a pose than its hips."""
        return self.pose is not None and not self.root_only

    @property
    def gives_facing(self) -> bool:
        """Whether it gives the hips' rotation."""
        return self.pose is not None or self.facing_deg is not None

    @property
    def gives_facing_alone(self) -> bool:
        """Whether it gives a facing and nothing else."""
        return self.pose is None and self.place is None and self.height is None


@dataclass(frozen=True, eq=False)
class Others:
    """Other characters, and the distance to keep from them."""

    hips: Float[Tensor, "others frames 2"]
    """Their hips on the ground from this shot's first frame on, at PRIOR_FPS, x and z, metres; the last frame holds."""
    distance: float
    """Least distance of hips, metres."""
    courtesy: bool = False
    """Whether they are only given room: they are solved later, and keep the distance themselves."""

    def at(self, frames: Int[Tensor, " frames"]) -> Float[Tensor, "others frames 2"]:
        """Return their hips at frames of the shot, metres."""
        return self.hips[:, frames.clamp(0, self.hips.shape[1] - 1)]


@dataclass(frozen=True, eq=False)
class ShotRequest:
    """Request for one character."""

    curve: Curve
    """Curve to walk, world, metres."""
    speed: SpeedProfile | TimedSpeed | None = None
    """Speed along it; None is USUAL_SPEED, and less in corners that turn faster than walking people do."""
    seconds: float | None = None
    """Duration, seconds; None walks the curve once."""
    lead: Lead | None = None
    """A clip to continue from, which ends where the curve begins; None begins anew."""
    stand_at_start: bool = False
    """Whether it begins standing at ease; if not it begins in its stride."""
    stand_at_end: bool = False
    """Whether it ends standing at ease."""
    arrival: Arrival | None = None
    """A clip to end in, which begins where the curve ends; None ends by itself."""
    loop: bool = False
    """Whether the last frame leads into the first: once around a closed curve."""
    reaches: tuple[Reach, ...] = ()
    """Targets of hands and feet."""
    looks: tuple[Look, ...] = ()
    """Points to look at."""
    poses: tuple[PoseKey, ...] = ()
    """Poses, positions and headings of the hips."""
    footsteps: tuple[Footstep, ...] = ()
    """Footsteps, as the report of a shot has them, some of them moved: where feet land, and when."""
    obstacles: tuple[Obstacle, ...] = ()
    """Obstacles to walk around."""
    others: Others | None = None
    """Others to keep apart from."""
    labels: tuple[str, ...] = ()
    """Labels on which the prior is conditioned; the gait that they name is measured."""
    ground: Ground | None = None
    """Ground that is not flat, onto which the motion is put."""

    @cached_property
    def walks_only(self) -> bool:
        """Whether it is nothing but a walk along the curve, in its stride, which needs no in-betweener."""
        ends = self.begins_standing or self.ends_standing or self.lead or self.arrival or self.loop
        more = self.reaches or self.looks or self.poses or self.obstacles or self.others
        if ends or more or isinstance(self.speed, TimedSpeed):
            return False
        return self.curve.closed or not find_reversals(self.curve)

    @property
    def begins_standing(self) -> bool:
        """Whether it begins standing: at ease, or as the clip does that it continues from."""
        return self.stand_at_start or (self.lead is not None and self.lead.stands)

    @property
    def ends_standing(self) -> bool:
        """Whether it ends standing: at ease, or as the clip does that it ends in."""
        return self.stand_at_end or (self.arrival is not None and self.arrival.stands)

    def __post_init__(self):
        timed = isinstance(self.speed, TimedSpeed)
        ends = self.begins_standing or self.ends_standing or self.lead is not None or self.arrival is not None
        faults = {
            "speeds by time need the shot's seconds": self.seconds is None and timed,
            "a shot continues from a clip or begins standing, not both": self.lead is not None and self.stand_at_start,
            "a shot ends in a clip or standing, not both": self.arrival is not None and self.stand_at_end,
            "a loop needs a closed curve, and this one is open": self.loop and not self.curve.closed,
            "a loop is walked once around, in its stride: without start, end, seconds, speeds by time": self.loop
            and (ends or self.seconds is not None or timed),
            "on a ground a shot has a curve of x,z and does not loop": (
                self.ground is not None and (self.loop or self.curve.dims == 3)
            ),
        }
        if fault := next((what for what, holds in faults.items() if holds), None):
            raise RequestError(fault)
        if self.curve.dims == 3:
            lowest, highest = (float(height) for height in self.curve.points[:, 1].aminmax())
            if lowest < _LOWEST_HIPS or highest - lowest > _MOST_RISE:
                raise RequestError(
                    f"the curve's heights, {lowest:.2f} to {highest:.2f} m, are not those of walking hips, and the "
                    "ground is level: give x,z"
                )
        for key in (*self.reaches, *self.looks, *self.poses):
            if self.seconds is not None and not 0 <= key.seconds <= self.seconds - key.hold_seconds:
                raise RequestError(
                    f"a key from {key.seconds:g} s to {key.seconds + key.hold_seconds:g} s is not within "
                    f"the shot's {self.seconds:g} s"
                )
        for one, other in combinations(self.reaches, 2):
            for name in one.positions.keys() & other.positions.keys():
                apart = math.dist(one.positions[name], other.positions[name])
                if apart > _SAME_POSITION and _are_together(one, other):
                    raise RequestError(
                        f"{name} is to be at two positions {100 * apart:.0f} cm apart within two frames, "
                        f"at {one.seconds:g} s and at {other.seconds:g} s"
                    )
        for one, other in combinations(self.poses, 2):
            if _are_together(one, other):
                raise RequestError(f"two poses are within two frames, at {one.seconds:g} s and at {other.seconds:g} s")
        self._check_obstacles()

    def lower_targets(self, rise: Float[Tensor, " frames"]) -> "ShotRequest":
        """Return the request with what is reached for and looked at lower by the ground's rise at that time, metres."""

        def lower(position: WorldPosition, seconds: float) -> WorldPosition:
            x, y, z = position
            return x, y - float(rise[min(round(seconds * PRIOR_FPS), len(rise) - 1)]), z

        reaches = tuple(
            replace(key, positions={name: lower(position, key.seconds) for name, position in key.positions.items()})
            for key in self.reaches
        )
        looks = tuple(replace(key, position=lower(key.position, key.seconds)) for key in self.looks)
        return replace(self, reaches=reaches, looks=looks)

    def lower_clips(self, ground: Ground, rest_height: float, curve: Curve, end: float) -> "ShotRequest":
        """Return the request with its clips over a flat floor, with toe joints at a height (metres) at rest: those that
        stand on the ground are lowered by as much. RequestError where the shot, which ends at an arc (metres) of a
        curve, would leave or meet one on ground that is not level."""

        def lower(motion: Motion, moved: Motion, seam: int) -> Motion:
            toes, there = (each.joint_positions()[seam, list(CANONICAL.indices(TOES))] for each in (motion, moved))
            low, high = ground.height(there[:, ::2]).aminmax()
            if float(high - low) > _LEVEL:
                raise RequestError(
                    f"a clip's feet are over ground that differs by {100 * float(high - low):.0f} cm where the shot"
                    " begins or ends in it; choose a frame over level ground"
                )
            own, over = ground.height(toes[:, ::2]).amin(), toes[:, 1].amin() - rest_height
            return lower_by(motion, torch.where((over - own).abs() < over.abs(), own, 0.0).expand(motion.num_frames))

        lead, arrival = self.lead, self.arrival
        return replace(
            self,
            lead=lead and Lead(lower(lead.motion, lead.motion, -1)),
            arrival=arrival and Arrival(lower(arrival.motion, arrival.bring_to(curve, end).motion, 0)),
        )

    def _check_obstacles(self) -> None:
        """Raise RequestError for an obstacle in which the curve begins or a key lies."""
        x, z = self.curve.ground_point(0.0).tolist()
        points = [("the start", (x, z))]
        points += [
            (f"the key at {key.seconds:g} s", (p[0], p[2])) for key in self.reaches for p in key.positions.values()
        ]
        points += [(f"the key at {key.seconds:g} s", key.place) for key in self.poses if key.place is not None]
        for obstacle in self.obstacles:
            for what, point in points:
                if float(obstacle.distance(torch.tensor(point, dtype=torch.float64))) < 0:
                    where = f"{obstacle.place[0]:g}, {obstacle.place[1]:g}"
                    raise RequestError(f"{what} is within the obstacle at {where}")


def _are_together(one: Reach | PoseKey, other: Reach | PoseKey) -> bool:
    """Return whether two keys hold within two frames of each other."""
    first, second = sorted((one, other), key=lambda key: key.seconds)
    return second.seconds - first.seconds - first.hold_seconds <= _APART_SECONDS
