"""Error estimates for gaps: errors measured on held-out clips, by proposer, length of the gap, and whether the body was
travelling.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length

TRAVELLING_SPEED = 0.35
"""Speed of the hips, m/s, from one end of a gap to the other, from which a body with canonical legs is travelling."""
_MIN_CLIPS = 5  # fewest clips for a 90th percentile
MEASURED_ERRORS: Mapping[tuple[str, str, bool], Sequence[tuple[int, float, float, int]]] = {
    ("rollout", "going", False): (
        (60, 9.7, 34.6, 15),
        (90, 16.7, 35.4, 15),
        (120, 16.4, 56.0, 12),
        (180, 17.1, 66.4, 8),
    ),
    ("rollout", "going", True): ((90, 7.5, 33.1, 14), (120, 12.9, 39.3, 10), (180, 41.4, 119.2, 4)),
    ("rollout", "in place", False): ((60, 18.9, 18.9, 1),),
}
"""Measured errors by proposer, whether the body was travelling, and whether frames beside the gap were known: frames of
the gap, median and 90th percentile of the error (cm), and number of clips; by `mapctl bench gaps --data DATA --count
25`."""

_MEASURED_SOURCES = {"rollout": "rollout", "density": "rollout"}


def is_travelling(motion: Motion, start: int, stop: int) -> bool:
    """Return whether the body (canonical joints) travels in a gap, faster than a shift of weight."""
    distance = float((motion.root_position[stop] - motion.root_position[start])[::2].norm())
    fastest_still = TRAVELLING_SPEED * (stop - start) / float(motion.fps)
    return distance * leg_length(CANONICAL) / leg_length(motion.skeleton) > fastest_still


@dataclass(frozen=True)
class ErrorEstimate:
    """Error of a proposal for a gap, mean over joints and frames, in the world."""

    median_cm: float
    """Median over held-out clips, cm."""
    percentile_90_cm: float
    """90th percentile over held-out clips, cm."""
    clips: int | None
    """Number of these clips; None where the proposer itself tells how sure it is, of each joint and frame."""

    @property
    def text(self) -> str:
        """The estimate in words."""
        if self.clips is None:
            return (
                f"by its own estimate joints within {self.median_cm:.1f} cm of the truth in half of cases and within"
                f" {self.percentile_90_cm:.1f} cm in nine of ten"
            )
        if self.clips < _MIN_CLIPS:
            return (
                f"joints about {self.median_cm:.0f} cm from mocap's in the only {self.clips} unseen clips of the kind"
            )
        return (
            f"joints within {self.median_cm:.0f} cm of mocap's in half of {self.clips} unseen clips and within"
            f" {self.percentile_90_cm:.0f} cm in nine of ten"
        )


def estimate_error(by: str, frames: int, *, travelling: bool, in_context: bool) -> ErrorEstimate | None:
    """Estimate the error of a proposal for a gap of so many frames at PRIOR_FPS; `in_context` where frames around it
    are known. None for a source, or a kind of gap, that was never measured.

    Linear between measured lengths; gaps longer than measured have the longest's error.
    """
    what = "going" if travelling else "in place"
    rows = MEASURED_ERRORS.get((_MEASURED_SOURCES.get(by.split(" ")[0], ""), what, in_context))
    if rows is None:
        return None
    lengths, median, percentile_90, clips = np.array(rows).T
    nearest = int(clips[np.abs(lengths - frames).argmin()])
    median_cm, percentile_90_cm = (float(np.interp(frames, lengths, errors)) for errors in (median, percentile_90))
    return ErrorEstimate(median_cm, percentile_90_cm, nearest)
