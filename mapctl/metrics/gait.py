"""Paces, and changes of pace: starts, stops, and changes between a walk and a run, by the hips' smoothed speed."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

_SMOOTH_SECONDS = 0.2  # standard deviation of a Gaussian over which sway within a stride is averaged out
STANDS, GOES = 0.2, 0.6
"""Speeds between which a start or a stop leads, m/s."""
WALKS, RUNS = 1.7, 2.1
"""Speeds between which a change of gait leads, m/s."""

PACES = "stand", "walk", "run"
"""Paces from slow to fast; moving without running is a walk."""
CHANGES = {
    ("stand", "walk"): "starts",
    ("walk", "stand"): "stops",
    ("walk", "run"): "changes to a run",
    ("run", "walk"): "changes to a walk",
}
"""Names of the changes from one pace to the next, by both."""


def label_pace(pace: str) -> str:
    """Return the label of a pace, `pace=walk`, for a density that is conditioned on it."""
    return f"pace={pace}"


def compute_ground_velocity(ground: Float[ndarray, "frames 2"], fps: float) -> Float[ndarray, "frames 2"]:
    """Compute the velocity of the hips over the ground, m/s, from their x and z in metres, without the sway within a
    stride; of at least two frames."""
    # Velocities are smoothed rather than positions: a run at a clip's end does not stop there.
    velocity = np.gradient(ground, 1 / fps, axis=0)
    return gaussian_filter1d(velocity, _SMOOTH_SECONDS * fps, axis=0, mode="nearest")


def measure_speed(ground: Float[ndarray, "frames 2"], fps: float) -> Float[ndarray, " frames"]:
    """Measure the speed of `compute_ground_velocity`, m/s; 0 for a single frame."""
    return np.linalg.norm(compute_ground_velocity(ground, fps), axis=1) if len(ground) > 1 else np.zeros(len(ground))


def count_pace_changes(speed: Float[ndarray, " frames"]) -> dict[str, int]:
    """Count each of CHANGES, by its name, along a motion's smoothed speed, m/s. A hesitation that does not pass both
    bounds changes nothing."""
    goes, runs = (_follow(speed, *bounds) for bounds in ((STANDS, GOES), (WALKS, RUNS)))
    counts = (int(np.count_nonzero(~fast[:-1] & fast[1:])) for fast in (goes, ~goes, runs, ~runs))
    return dict(zip(CHANGES.values(), counts, strict=True))


def follow_pace(speed: Float[ndarray, " frames"]) -> Int[ndarray, " frames"]:
    """Follow the pace along a motion's smoothed speed, m/s: the index in PACES of each frame.

    A pace lasts until the other bound of a change is passed, so that `count_pace_changes` counts the changes of it;
    before the first bound that is passed, it is the one that this bound shows.
    """
    goes, runs = (_follow(speed, *bounds) for bounds in ((STANDS, GOES), (WALKS, RUNS)))
    return np.where(runs, 2, goes.astype(int))


def find_pace(speed: float) -> str:
    """Find the pace of a mean speed, m/s, halfway between the bounds of changes."""
    return PACES[(speed > (STANDS + GOES) / 2) + (speed > (WALKS + RUNS) / 2)]


RUN_FLIGHT = 0.1
"""Share of the time without a planted toe above which a gait is a run: captured runs have 0.14 to 0.68, walks up to
0.06."""


def find_gait(labels: Sequence[str]) -> str | None:
    """Return the gait that labels of a density name (`run`, `gait=walk-turn-left`): run or walk; None for neither."""
    words = [label.split("=")[-1].split("-")[0] for label in labels]
    return next((word for word in words if word in PACES[1:]), None)


def measure_flight(planted: Bool[Tensor, "frames feet"]) -> float:
    """Measure the share of frames in which no toe is planted."""
    return float((~planted.any(dim=-1)).float().mean())


def _follow(speed: Float[ndarray, " frames"], low: float, high: float) -> Bool[ndarray, " frames"]:
    """Whether it was over `high` since it was last under `low`. Before either, the first of them counts; between both
    all along, the mean."""
    passed = np.flatnonzero((speed < low) | (speed > high))
    if len(passed) == 0:
        return np.full(len(speed), len(speed) > 0 and float(np.mean(speed)) > (low + high) / 2)
    last = np.searchsorted(passed, np.arange(len(speed)), side="right") - 1
    return (speed > high)[passed[np.maximum(last, 0)]]


LONGEST_STEP = 1.0
"""Longest step, seconds; touch-downs further apart have a contact between them that was not detected."""


def step_lengths(
    toes_xz: Float[Tensor, "frames feet 2"], planted: Bool[Tensor, "frames feet"], fps: float
) -> Float[Tensor, "frames"]:
    """Return the length of the step that a touch-down ends in its frame, metres; NaN where none does.

    A touch-down is the first frame of a contact. Two in a row of one foot make no step, nor do two that are
    `LONGEST_STEP` apart.
    """
    lengths = torch.full((len(planted),), float("nan"), dtype=toes_xz.dtype)
    downs = ((planted[1:] & ~planted[:-1]).nonzero() + planted.new_tensor([1, 0], dtype=torch.long)).tolist()
    for (before, other), (frame, foot) in pairwise(downs):
        if foot != other and frame - before < LONGEST_STEP * fps:
            lengths[frame] = (toes_xz[frame, foot] - toes_xz[before, other]).norm()
    return lengths
