"""Starts, stops and changes of gait: counted where both bounds are passed, for cards and for free runs alike."""

import numpy as np
import pytest

from mapctl.metrics.gait import CHANGES, compute_ground_velocity, count_pace_changes, follow_pace


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ([0.0, 1.2, 0.0, 1.2], (2, 1, 0, 0)),
        ([1.2, 0.4, 1.2], (0, 0, 0, 0)),  # a hesitation
        ([0.0, 0.4, 0.0], (0, 0, 0, 0)),
        ([1.2, 3.0, 1.2], (0, 0, 1, 1)),
        ([2.0, 1.8, 2.0], (0, 0, 0, 0)),  # between a walk and a run all along
        ([0.0, 3.0], (1, 0, 1, 0)),
        ([], (0, 0, 0, 0)),
    ],
)
def test_changes_are_counted_where_both_bounds_are_passed(speeds, expected):
    counted = count_pace_changes(np.repeat(np.array(speeds), 30))
    assert counted == dict(zip(CHANGES.values(), expected, strict=True))


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_sway_within_a_stride_is_no_change(fps):
    """1 m/s that swings by half of it, twice a second, as hips do."""
    seconds = np.arange(0, 6, 1 / fps)
    way = seconds + 0.5 * np.sin(2 * np.pi * 2 * seconds) / (2 * np.pi * 2)
    velocity = compute_ground_velocity(np.stack([0 * way, way], axis=1), fps)
    within = velocity[round(fps) : -round(fps), 1]
    assert np.abs(within - 1).max() < 0.05
    assert abs(within.mean() - 1) < 0.01


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ([0.0, 1.2, 0.0], [0, 1, 0]),
        ([1.2, 0.4, 0.0, 0.4, 1.2], [1, 1, 0, 0, 1]),  # who slows down walks until he stands
        ([1.2, 1.9, 2.5, 1.9, 1.2], [1, 1, 2, 2, 1]),
        ([3.0, 0.0], [2, 0]),
        ([0.4, 0.0, 1.2], [0, 0, 1]),  # before the first bound, as it is
        ([0.4, 1.2], [1, 1]),
        ([0.45], [1]),
        ([0.3], [0]),
        ([1.8], [1]),
        ([], []),
    ],
)
def test_a_pace_lasts_until_the_other_bound(speeds, expected):
    assert follow_pace(np.repeat(np.array(speeds), 5)).tolist() == [pace for pace in expected for _ in range(5)]
