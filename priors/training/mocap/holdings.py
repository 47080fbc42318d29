"""What a corpus holds: minutes by speed, starts and stops, turns, contacts. What is not in it cannot be learnt."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import gaussian_filter1d

from mapctl.features import LAYOUT, PRIOR_FPS
from mapctl.metrics.pace_changes import PACES, PaceChanges, compute_ground_velocity, count_pace_changes, follow_pace
from priors.training.corpus import Corpus

SPEEDS = (0.15, 0.6, 1.1, 1.6, 2.2)
"""Bounds between classes of the hips' speed, m/s: standing, slow steps, slow walks, walks, fast walks, runs."""
TURNING = 45.0
"""From this on a heading's change counts as a turn, degrees a second."""
_SMOOTH = 0.2 * PRIOR_FPS  # frames, standard deviation, over which sway within a stride is averaged out
_SPOT, _WAY = 0.3, 0.5  # m/s up to which a turn is on the spot, and from which on one is under way


def measure_holdings(corpus: Corpus) -> dict[str, float | dict[str, float]]:
    """Measure what the clips hold, by the hips' smoothed speed and heading, for a card.

    Minutes in all, by speed and by pace (stand, walk, run); starts (from under 0.2 to over 0.6 m/s) and stops, changes
    to a run (from under 1.7 to over 2.1 m/s) and to a walk; seconds of turning on the spot and under way, of going
    backwards and sideways; the share of frames in which a foot is planted.
    """
    ground, heading = corpus.integrate_roots()
    parts = [
        _track(places.double().numpy(), turns.double().numpy())
        for places, turns in zip(ground.split(list(corpus.lengths)), heading.split(list(corpus.lengths)), strict=True)
    ]
    speed, turn, aside = (np.concatenate([part[k] for part in parts]) for k in range(3))
    pace = np.bincount(np.concatenate([follow_pace(speeds) for speeds, _, _ in parts]), minlength=len(PACES))
    way = speed > _WAY
    changes = sum((count_pace_changes(speeds) for speeds, _, _ in parts), PaceChanges())
    seconds = {
        "turning on the spot": (speed < _SPOT) & (turn > TURNING),
        "turning under way": way & (turn > TURNING),
        "going backwards": way & (aside > 120),
        "going sideways": way & (aside > 60) & (aside <= 120),
    }
    return {
        "minutes": _to_minutes(len(speed)),
        "minutes by speed": _split_by_speed(speed),
        "minutes by pace": {name: _to_minutes(count) for name, count in zip(PACES, pace, strict=True)},
        **{name: float(count) for name, count in changes.by_name().items()},
        **{f"seconds of {name}": round(float(chosen.sum()) / PRIOR_FPS, 1) for name, chosen in seconds.items()},
        "share of frames with a foot planted, each": round(
            float(LAYOUT.pick(corpus.features, "contacts").float().mean()), 3
        ),
    }


def _split_by_speed(speed: Float[ndarray, " frames"]) -> dict[str, float]:
    """Minutes in each class of speed, by the class's name."""
    classes = np.bincount(np.digitize(speed, SPEEDS), minlength=len(SPEEDS) + 1)
    names = [f"under {SPEEDS[0]} m/s", *(f"to {bound}" for bound in SPEEDS[1:]), "over"]
    return {name: _to_minutes(count) for name, count in zip(names, classes, strict=True)}


def _to_minutes(frames: int | np.integer) -> float:
    return round(int(frames) / PRIOR_FPS / 60, 2)


def _track(
    ground: Float[ndarray, "frames 2"], heading: Float[ndarray, " frames"]
) -> tuple[Float[ndarray, " frames"], Float[ndarray, " frames"], Float[ndarray, " frames"]]:
    """Speed (m/s), rate of turning and angle between heading and way (degrees), both without sign."""
    if len(heading) < 2:
        return np.zeros(len(heading)), np.zeros(len(heading)), np.zeros(len(heading))
    smooth = gaussian_filter1d(heading, _SMOOTH, mode="nearest")
    velocity = compute_ground_velocity(ground, PRIOR_FPS)
    turn = np.degrees(gaussian_filter1d(np.gradient(heading, 1 / PRIOR_FPS), _SMOOTH, mode="nearest"))
    aside = np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1]) - smooth)
    return np.linalg.norm(velocity, axis=1), np.abs(turn), np.abs((aside + 180) % 360 - 180)
