"""The in-betweening bench: what it measures of made-up clips."""

import math

from helpers import tiny_density, walk
from tiny_infiller import tiny_infiller

from controllers.benchmarks.tweening import TWEEN_FRAMES, benchmark_tweening


def test_rows_by_kind_task_and_method_of_the_clips_that_are_long_enough():
    kinds = {"walks": [walk(TWEEN_FRAMES, cadence=1.2)], "short": [walk(60)]}
    seen = []
    rows = benchmark_tweening(kinds, tiny_infiller(drawn=0.02), [tiny_density()], progress=lambda *at: seen.append(at))
    assert seen == [(1, 2), (2, 2)]
    assert [(row["kind"], row["what"], row["by"]) for row in rows] == [
        ("walks", "keys", "chosen"),
        ("walks", "keys", "rolled"),
        ("walks", "keys", "best of 4"),
        *(("walks", f"end of {count} frames", by) for count in (30, 60) for by in ("infiller", "density")),
    ]
    for row in rows[:2]:
        assert row["key_mm"] == 0
        assert row["error_cm"] > 0
        assert row["jerk_at_keys"] > 0
    assert all(math.isfinite(row["skate_cm_s"]) and row["ms_frame"] > 0 for row in rows)
    assert rows[0]["mocap_skate"] == rows[1]["mocap_skate"]
