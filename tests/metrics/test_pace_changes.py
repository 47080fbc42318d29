"""Starts, stops and changes of gait: counted where both bounds are passed, for cards and for free runs alike."""

import numpy as np
import pytest

from mapctl.metrics.gait import PACES, PaceChanges, compute_ground_velocity, count_pace_changes, find_pace, follow_pace


@pytest.mark.parametrize(
    ("speeds", "expected"),
    [
        ([0.0, 1.2, 0.0, 1.2], PaceChanges(starts=2, stops=1)),
        ([1.2, 0.4, 1.2], PaceChanges()),  # a hesitation
        ([0.0, 0.4, 0.0], PaceChanges()),
        ([1.2, 3.0, 1.2], PaceChanges(to_run=1, to_walk=1)),
        ([2.0, 1.8, 2.0], PaceChanges()),  # between a walk and a run all along
        ([0.0, 3.0], PaceChanges(starts=1, to_run=1)),
        ([], PaceChanges()),
    ],
)
def test_changes_are_counted_where_both_bounds_are_passed(speeds, expected):
    assert count_pace_changes(np.repeat(np.array(speeds), 30)) == expected


def test_a_walk_backwards_in_time_exchanges_what_begins_and_what_ends():
    rng = np.random.default_rng(0)
    speed = np.repeat(rng.uniform(0, 4, 200), 10)
    there, back = count_pace_changes(speed), count_pace_changes(speed[::-1])
    assert (there.starts, there.stops, there.to_run, there.to_walk) == (
        back.stops,
        back.starts,
        back.to_walk,
        back.to_run,
    )
    assert abs(there.starts - there.stops) <= 1
    assert there.starts > 10


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
        ([0.4, 0.0, 1.2], [0, 0, 1]),  # before the first bound, what it tells
        ([0.4, 1.2], [1, 1]),
        ([0.45], [1]),
        ([0.3], [0]),
        ([1.8], [1]),
        ([], []),
    ],
)
def test_a_pace_lasts_until_the_other_bound(speeds, expected):
    assert follow_pace(np.repeat(np.array(speeds), 5)).tolist() == [pace for pace in expected for _ in range(5)]


def test_what_is_counted_is_changes_of_the_pace():
    speed = np.repeat(np.random.default_rng(1).uniform(0, 4, 300), 5)
    pace, counted = follow_pace(speed), count_pace_changes(speed)
    assert counted.starts == np.count_nonzero((pace[:-1] == 0) & (pace[1:] > 0))
    assert counted.stops == np.count_nonzero((pace[:-1] > 0) & (pace[1:] == 0))
    assert counted.to_run == np.count_nonzero((pace[:-1] < 2) & (pace[1:] == 2))
    assert counted.to_walk == np.count_nonzero((pace[:-1] == 2) & (pace[1:] < 2))
    assert min(counted.starts, counted.stops, counted.to_run, counted.to_walk) > 5


def test_a_mean_speed_has_the_pace_of_a_steady_motion():
    for speed in (0.0, 0.1, 1.0, 1.5, 2.2, 4.0):
        assert PACES.index(find_pace(speed)) == int(follow_pace(np.full(10, speed))[-1])


def test_who_goes_at_the_ends_of_a_clip_goes_on_at_his_pace():
    """As clips of runs are cut: nobody stands before the first frame and after the last."""
    way = 3.0 * np.arange(60) / 30
    velocity = compute_ground_velocity(np.stack([0 * way, way], axis=1), 30)
    np.testing.assert_allclose(velocity, np.tile([0.0, 3.0], (60, 1)), atol=1e-9)
    assert count_pace_changes(np.linalg.norm(velocity, axis=1)) == PaceChanges()
