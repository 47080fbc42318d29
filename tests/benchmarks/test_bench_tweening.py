"""The in-betweening bench: what it measures of made-up clips."""

import math

import pytest
from helpers import tiny_density, walk
from tiny_infiller import tiny_infiller

from controllers.benchmarks import tweening


@pytest.mark.parametrize("small", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_rows_by_kind_task_and_method_of_the_clips_that_are_long_enough(monkeypatch, small):
    if small:
        sizes = {"TWEEN_FRAMES": 22, "_END_SOURCE_FRAMES": 22, "_INNER_KEYS": 1, "_END_LENGTHS": (4, 8)}
        for name, size in (sizes | {"_NUM_ALTERNATIVES": 2}).items():
            monkeypatch.setattr(tweening, name, size)
    kinds = {"walks": [walk(tweening.TWEEN_FRAMES, cadence=1.2)], "short": [walk(tweening.TWEEN_FRAMES // 3)]}
    seen = []
    rows = tweening.benchmark_tweening(
        kinds, tiny_infiller(drawn=0.02), [tiny_density()], progress=lambda *at: seen.append(at)
    )
    assert seen == [(1, 2), (2, 2)]
    assert [(row["kind"], row["what"], row["by"]) for row in rows] == [
        ("walks", "keys", "chosen"),
        ("walks", "keys", "rolled"),
        ("walks", "keys", f"best of {tweening._NUM_ALTERNATIVES}"),
        *(("walks", f"end of {count} frames", by) for count in tweening._END_LENGTHS for by in ("network", "density")),
    ]
    for row in rows[:2]:
        assert row["key_mm"] == 0
        assert row["error_cm"] > 0
        assert row["jerk_at_keys"] > 0
    assert all(math.isfinite(row["skate_cm_s"]) and row["ms_frame"] > 0 for row in rows)
    assert rows[0]["mocap_skate"] == rows[1]["mocap_skate"]
