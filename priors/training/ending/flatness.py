"""Whether a curve of validations has become flat, told from how it falls and how it is scattered."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import theilslopes

Point = tuple[int, float]
"""A step, and the logarithm of an error that was measured there."""
LEAST_POINTS = 6
"""Validations in the last third, without which nothing is said of a curve."""
_CONFIDENCE = 0.6  # of an interval with two ends: one line of five falls faster than its steeper end


def is_flat(points: Sequence[Point], share: float) -> bool:
    """Return whether at the last validation and at the one before an error surely falls by less than this share over
    the last third of the steps (see `find_greatest_gain`)."""
    gains = [find_greatest_gain(points[: len(points) - back]) for back in (0, 1)]
    return all(gain is not None and gain < share for gain in gains)


def find_greatest_gain(points: Sequence[Point]) -> float | None:
    """Find by how much, as a share, the error fell at most over the last third of the steps; negative where it rose.
    None where fewer than LEAST_POINTS were measured there.

    The line through the points is that of Theil (1950) and Sen (1968), the median of the slopes between any two, which
    a few outliers do not move. What counts is the steeper end of the interval that holds its slope in three of five
    cases: the more the curve is scattered, the longer one has to look before it is called flat.
    """
    if not points:
        return None
    end = points[-1][0]
    steps, errors = zip(*((step, error) for step, error in points if 3 * step > 2 * end), strict=True)
    if len(steps) < LEAST_POINTS:
        return None
    _, _, steepest, _ = np.asarray(theilslopes(errors, steps, alpha=_CONFIDENCE)).tolist()
    return -steepest * end / 3
