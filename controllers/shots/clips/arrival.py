"""A clip that a shot ends in: the shot's last frame is a frame of the clip, and moves as the clip does there."""

from dataclasses import dataclass, replace

import torch

from controllers.inbetweening.pipeline import fill
from controllers.shots.clips.lead import STANDING_SPEED, TRAVEL_FRAMES
from controllers.shots.transitions import Filling, choose_filling
from mapctl import kinematics
from mapctl.curves import Curve
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.kinematics.placing import bring_curve_points, measure_travel, move_to, rotate_about_vertical
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener

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
