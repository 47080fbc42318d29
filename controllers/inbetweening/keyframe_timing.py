"""Suggested timing of keyframes: time from one to the next by a model of mocap, beside the given time."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch

from mapctl.errors import RequestError
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
    """Interval between two neighbouring keyframes that are whole poses."""

    start: int
    """Frame of the first keyframe."""
    stop: int
    """Frame of the second keyframe."""
    suggested: int
    """Median number of frames between such poses in mocap."""
    usual: tuple[int, int]
    """Numbers of frames between which four of five of mocap's pairs lie."""
    metres: float
    """Distance of the hips over the ground, on this body, metres."""
    given_speed: float
    """Mean speed over this distance with the given timing, m/s."""
    suggested_speed: float
    """Mean speed over this distance with the suggested timing, m/s."""
    pose_distance_cm: float
    """Mean distance of the joints relative to the hips, cm."""

    @property
    def given(self) -> int:
        """Given number of frames between the keyframes."""
        return self.stop - self.start

    @property
    def reason(self) -> str:
        """Reason for the suggestion, with numbers."""
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
        """Return the interval as a report's JSON has it."""
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
    """Suggest the time between neighbouring keyframes that are whole poses; others may lie between. RequestError for
    keys that do not fit the motion, and for fewer than two such poses.
    """
    key_frames = [key.frame for key in keys.checked(motion) if key.what == "pose"]
    if len(key_frames) < 2:
        raise RequestError(f"timing is suggested between whole poses; the keys have {len(key_frames)}, it takes two")
    canonical = to_canonical(_select_frames(motion, key_frames), rig)[0]
    scale, fps = leg_length(canonical.skeleton) / leg_length(CANONICAL), float(motion.fps)
    body = Motion(CANONICAL, canonical.fps, canonical.root_position / scale, canonical.local_quat_xyzw)
    first = torch.arange(len(key_frames) - 1)
    distances = compute_travel_distance(body, first, first + 1)
    quantiles = (fps * timing.estimate_seconds(compute_pair_features(body, first, first + 1), distances)).tolist()
    metres = (scale * distances).tolist()
    pose_distances = (100 * scale * compute_pose_distance(body, first, first + 1)).tolist()
    intervals = []
    each = zip(pairwise(key_frames), quantiles, metres, pose_distances, strict=True)
    for (start, stop), counts, distance, pose_distance in each:
        low, suggested, high = (max(1, round(count)) for count in counts)
        speeds = distance * fps / (stop - start), distance * fps / suggested
        intervals.append(KeyInterval(start, stop, suggested, (low, high), distance, *speeds, pose_distance))
    return intervals


def _select_frames(motion: Motion, frames: Sequence[int]) -> Motion:
    """Return a motion of these frames alone."""
    picked = torch.tensor(frames)
    moving = {joint: values[picked] for joint, values in motion.moving_offsets.items()}
    return Motion(motion.skeleton, motion.fps, motion.root_position[picked], motion.local_quat_xyzw[picked], moving)
