"""Ranges of mocap that synthesised motion is held to: none of its worst frames may be worse than in most clips."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from mapctl import metrics
from mapctl.joint_roles import find_feet, find_hips
from mapctl.metrics.worst_frame import measure_longest_unsupported, measure_peaks
from mapctl.motion import Motion

CHECKED = (
    "contact_speed_cm_s",
    "penetration_cm",
    "jitter_m_s3",
    "largest_step_cm",
    "largest_acceleration_m_s2",
    "longest_slide_s",
)
"""Mean speed of planted toes, depth under the floor, mean jerk; over all joints and frames the largest step about the
hips in a thirtieth of a second, and the largest acceleration; and for how long the body goes while no low toe
stands."""
_RANGE = 95.0  # percentile over the reference's clips that no made clip may exceed
_LEAST_FRAMES = 30  # of a clip that says something


def measure_checked(motion: Motion) -> dict[str, float]:
    """The measures of CHECKED of a motion."""
    found, places = metrics.measure(motion), motion.joint_positions()
    hips, toes = places[:, find_hips(motion.skeleton)], places[:, list(find_feet(motion.skeleton))]
    fps = float(motion.fps)
    peaks = measure_peaks(places, hips, fps)
    own = {
        "largest_step_cm": 100 * peaks.step,
        "largest_acceleration_m_s2": peaks.acceleration,
        "longest_slide_s": measure_longest_unsupported(toes, hips, fps),
    }
    return {name: own.get(name, found.get(name, math.nan)) for name in CHECKED}


def find_bounds(reference: Iterable[Motion]) -> dict[str, float]:
    """By measure what 95 % of the clips stay under; clips of less than a second say nothing."""
    rows = [measure_checked(motion) for motion in reference if motion.num_frames >= _LEAST_FRAMES]
    return {name: float(np.nanpercentile([row[name] for row in rows], _RANGE)) for name in CHECKED if rows}


def list_faults(measures: Mapping[str, float], bounds: Mapping[str, float]) -> list[str]:
    """By how much measures exceed the bounds, in words; what cannot be measured, as of feet that never stand, is a
    fault."""
    return [
        f"{name} {measures[name]:.3g}, allowed are {bound:.3g}"
        for name, bound in bounds.items()
        if not measures[name] <= bound
    ]
