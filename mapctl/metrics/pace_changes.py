"""Changes of pace: starts, stops, and changes between a walk and a run, by the hips' smoothed speed."""

from dataclasses import astuple, dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import gaussian_filter1d

_SMOOTH_SECONDS = 0.2  # standard deviation of a Gaussian over which sway within a stride is averaged out
_STANDS, _GOES = 0.2, 0.6  # m/s between which a start or a stop leads
_WALKS, _RUNS = 1.7, 2.1  # m/s between which a change of gait leads


@dataclass(frozen=True)
class PaceChanges:
    """How often the pace of one motion changes."""

    starts: int = 0
    """From under 0.2 to over 0.6 m/s."""
    stops: int = 0
    """From over 0.6 to under 0.2 m/s."""
    to_run: int = 0
    """From under 1.7 to over 2.1 m/s."""
    to_walk: int = 0
    """From over 2.1 to under 1.7 m/s."""

    def __add__(self, other: "PaceChanges") -> "PaceChanges":
        return PaceChanges(*(one + another for one, another in zip(astuple(self), astuple(other), strict=True)))


def compute_ground_velocity(ground: Float[ndarray, "frames 2"], fps: float) -> Float[ndarray, "frames 2"]:
    """Compute the velocity of the hips over the ground, m/s, from their x and z in metres, without the sway within a
    stride; of at least two frames."""
    smooth = gaussian_filter1d(ground, _SMOOTH_SECONDS * fps, axis=0, mode="nearest")
    return np.gradient(smooth, 1 / fps, axis=0)


def count_pace_changes(speed: Float[ndarray, " frames"]) -> PaceChanges:
    """Count the changes along a motion's smoothed speed, m/s. Who hesitates without passing both bounds changes
    nothing."""
    stops, starts = _count_crossings(speed, _STANDS, _GOES)
    to_walk, to_run = _count_crossings(speed, _WALKS, _RUNS)
    return PaceChanges(starts, stops, to_run, to_walk)


def _count_crossings(speed: Float[ndarray, " frames"], low: float, high: float) -> tuple[int, int]:
    """How often it falls from over `high` to under `low`, and how often it rises the other way."""
    fast = [bool(value > high) for value in speed if value < low or value > high]
    pairs = list(pairwise(fast))
    return pairs.count((True, False)), pairs.count((False, True))
