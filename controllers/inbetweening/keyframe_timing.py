"""How long the way from one keyframe to the next takes people, as a model of mocap has it, beside what is given."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch

from mapctl.inbetweening.pose_pairs import (
    TRAVELLING_DISTANCE,
    TimingModel,
    compute_pair_features,
    compute_pose_distance,
    compute_travel_distance,
)
from mapctl.intent.keyframes import Keys
from mapctl.motion import Motion
from mapctl.retarget import to_canonical
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL, leg_length


@dataclass(frozen=True)
class KeyInterval:
    """Between two neighbouring keys that are whole poses."""

    start: int
    """Frame of the first."""
    stop: int
    """And of the second."""
    suggested: int
    """Frames from one to the other as mocap would have it."""
    usual: tuple[int, int]
    """Frames within which four of five of mocap's pairs would lie."""
    metres: float
    """From hips to hips over the ground, on this body."""
    given_speed: float
    """Over these, m/s, with the given timing."""
    suggested_speed: float
    """And with the suggested one."""
    pose_distance_cm: float
    """Mean distance of the joints seen from the hips."""

    @property
    def given(self) -> int:
        """Frames from one to the other."""
        return self.stop - self.start

    @property
    def reason(self) -> str:
        """Why, in numbers."""
        low, high = self.usual
        verdict = "short" if self.given < low else "long" if self.given > high else "usual"
        if self.metres < TRAVELLING_DISTANCE:
            return (
                f"{verdict}: about in place ({self.metres:.2f} m), joints {self.pose_distance_cm:.0f} cm apart; mocap "
                f"mostly takes {low} to {high} frames"
            )
        return (
            f"{verdict}: {self.metres:.2f} m at {self.given_speed:.2f} m/s, where poses like these go at "
            f"{self.suggested_speed:.2f} m/s; mocap mostly takes {low} to {high} frames"
        )

    def summary(self) -> dict[str, Any]:
        """For a report."""
        return {
            "from": self.start,
            "to": self.stop,
            "given": self.given,
            "suggested": self.suggested,
            "usual": list(self.usual),
            "metres": self.metres,
            "given_m_s": self.given_speed,
            "suggested_m_s": self.suggested_speed,
            "apart_cm": self.pose_distance_cm,
            "reason": self.reason,
        }


def suggest_intervals(motion: Motion, keys: Keys, timing: TimingModel, rig: Rig | None = None) -> list[KeyInterval]:
    """For neighbouring keys that are whole poses how long the way between them would take; keys that tell less lie
    within. RequestError for keys that do not fit the motion.
    """
    wanted = [key.frame for key in keys.checked(motion) if key.what == "pose"]
    canonical = to_canonical(_select_frames(motion, wanted), rig)[0]
    scale, fps = leg_length(canonical.skeleton) / leg_length(CANONICAL), float(motion.fps)
    body = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    first = torch.arange(len(wanted) - 1)
    ways = compute_travel_distance(body, first, first + 1)
    usual = (fps * timing.estimate_seconds(compute_pair_features(body, first, first + 1), ways)).tolist()
    metres = (scale * ways).tolist()
    apart = (100 * scale * compute_pose_distance(body, first, first + 1)).tolist()
    intervals = []
    for number, (start, stop) in enumerate(pairwise(wanted)):
        low, suggested, high = (max(1, round(frames)) for frames in usual[number])
        intervals.append(
            KeyInterval(
                start,
                stop,
                suggested,
                (low, high),
                metres[number],
                metres[number] * fps / (stop - start),
                metres[number] * fps / suggested,
                apart[number],
            )
        )
    return intervals


def _select_frames(motion: Motion, frames: Sequence[int]) -> Motion:
    """These frames alone."""
    picked = torch.tensor(frames)
    moving = {joint: values[picked] for joint, values in motion.moving_offsets.items()}
    return Motion(motion.skeleton, motion.fps, motion.root_position[picked], motion.local_quat_xyzw[picked], moving)
