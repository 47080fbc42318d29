"""The frame rate behind an animation's key times, and the frames at which it is read."""

from fractions import Fraction

import numpy as np

from mapctl.formats.frame_rate import FASTEST, frame_rate

_DEFAULT_FPS = Fraction(30)
_UNEVEN_SHARE = 0.02  # of a frame that a key may lie beside it


def sample_times(keys: np.ndarray) -> tuple[Fraction, np.ndarray]:
    """Return frames per second and the times, seconds, at which to read an animation with keys at these times.

    Keys that lie on the frames of one rate (not on all of them need one lie) give that rate; others are read at 30
    frames a second, the last key at or before the last frame.
    """
    keys = np.unique(np.asarray(keys, np.float64))
    if len(keys) < 2:
        return _DEFAULT_FPS, keys[:1] if len(keys) else np.zeros(1)
    span = keys[-1] - keys[0]
    fps = _find_rate(keys - keys[0])
    count = int(np.floor(span * float(fps) + _UNEVEN_SHARE)) + 1
    return fps, keys[0] + np.arange(count) / float(fps)


def _find_rate(keys: np.ndarray) -> Fraction:
    """Return the rate of which every key, from 0 on, is a frame; 30 where there is none."""
    apart = np.diff(keys)
    step = float(np.median(apart[apart > 0.25 * np.median(apart)]))
    candidates = [step, *(step / part for part in (2, 3, 4, 5)), 1 / 30, 1 / 24, 1 / 25, 1 / 60, 1 / 120]
    for seconds in candidates:
        if not 1 / FASTEST < seconds < 100:
            continue
        seconds = keys[-1] / max(1, round(keys[-1] / seconds))  # keys are rounded one by one, their whole span hardly
        fps = frame_rate(f"{seconds:.7f}") if seconds > 1e-4 else Fraction(1 / seconds)
        frames = keys * float(fps)
        if np.abs(frames - np.rint(frames)).max() < _UNEVEN_SHARE:
            return fps
    return _DEFAULT_FPS
