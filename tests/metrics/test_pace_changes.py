"""Starts, stops and changes of gait: counted where both bounds are passed, for cards and for free runs alike."""

import numpy as np
import pytest
from helpers import go_at, tiny_density

from controllers.benchmarks import free_run
from mapctl.metrics.pace_changes import PaceChanges, compute_ground_velocity, count_pace_changes


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


def test_the_table_of_free_runs_counts_over_ten_minutes(monkeypatch):
    features = go_at(0.0, 1.2, 3.0, 1.2, seconds=10)
    monkeypatch.setattr(free_run, "_sample_free_run", lambda prior, frames, seed: features)
    *_, together, data = free_run.benchmark_free_run(tiny_density(), {"speed": 1.0}, runs=2, frames=len(features))
    minutes = len(features) / 30 / 60
    names = ("starts", "stops", "to_run", "to_walk")
    assert [together[f"{name}_10min"] * minutes / 10 for name in names] == pytest.approx([1, 0, 1, 1])
    assert data == {"run": "training data", "speed": 1.0}


def test_the_row_of_the_data_has_what_its_card_tells():
    holds = {"minutes": 5.0, "starts": 3.0, "stops": 2.0, "changes to a run": 1.0, "changes to a walk": 0.0}
    found = free_run.summarise_held_changes(holds)
    assert found == {"starts_10min": 6.0, "stops_10min": 4.0, "to_run_10min": 2.0, "to_walk_10min": 0.0}
    del holds["changes to a run"]
    assert free_run.summarise_held_changes(holds) == {name: found[name] for name in found if name != "to_run_10min"}
    assert free_run.summarise_held_changes({}) == {}
