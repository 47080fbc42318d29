"""The in-betweening bench: what it measures of made-up clips."""

import math
from types import SimpleNamespace

import pytest
import torch
from helpers import tiny_density, walk
from tiny_infiller import tiny_infiller

from controllers.benchmarks import tweening
from controllers.benchmarks.shared.tables import average_rows


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


def test_models_are_asked_for_the_same_keys_whatever_they_draw(monkeypatch):
    asked = {0: [], 7: []}
    for draws, keys_of in asked.items():

        def answer(clip, keys, inbetweener, densities, generator, draws=draws, keys_of=keys_of):
            torch.rand(draws, generator=generator)
            keys_of.append(keys.frames)
            return [SimpleNamespace(motion=clip, seconds=1.0) for _ in range(3)]

        monkeypatch.setattr(tweening, "_tween_by_all_methods", answer)
        monkeypatch.setattr(tweening, "_END_SOURCE_FRAMES", 1000)
        monkeypatch.setattr(tweening, "TWEEN_FRAMES", 30)
        tweening.benchmark_tweening({"walks": [walk(30)] * 3}, tiny_infiller(), [tiny_density()])
    assert asked[0] == asked[7]
    assert len({*asked[0]}) == 3


def test_the_worst_frames_of_clips_are_no_means():
    rows = [{"step_cm": 3.0, "error_cm": 3.0}, {"step_cm": 9.0, "error_cm": 9.0}, {"step_cm": math.nan, "error_cm": 0}]
    assert average_rows(rows, worst=tweening._WORST) == {"step_cm": 9, "error_cm": 4}
