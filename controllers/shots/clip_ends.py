"""A clip that a shot goes on from: where it ends, the shot begins, in the same pose and the same stride."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.common.character import Character
from controllers.common.initial_state import MotionStart, start_from_state
from controllers.inbetweening.pipeline import fill
from controllers.shots.transitions import Filling, choose_filling
from mapctl import kinematics
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS, GroundPose, encode, integrate_root
from mapctl.inbetweening.missing import MissingMask
from mapctl.kinematics.placing import bring_curve_points, measure_travel, move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.problem.receding_horizon import replay
from mapctl.protocols import Density, Inbetweener

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
