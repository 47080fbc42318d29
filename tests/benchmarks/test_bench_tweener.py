"""The bench of generative tweening: what it measures of made-up clips."""

import json
import math
from dataclasses import replace

import pytest
import torch
from helpers import run, walk
from tiny_path import ToldPath, save_tiny_path, tiny_path

from controllers.benchmarks.tweener.root_prediction import (
    AnchoredToePath,
    StillPath,
    benchmark_root_prediction,
    measure_root_prediction,
)
from controllers.benchmarks.tweener.walked_in_place import benchmark_walked_in_place, measure_walked_in_place
from mapctl.skeleton import CANONICAL, TOE_JOINTS


def held_toe(frames=80):
    """A walk whose left toe stands still throughout, on the floor."""
    motion = walk(frames)
    toes = motion.joint_positions()[:, TOE_JOINTS[0]]
    root = motion.root_position - toes + torch.tensor([0.0, 0.0425, 0.0]).double()
    return replace(motion, root_position=root)


def test_who_is_told_the_truth_has_no_error():
    motion = walk(90, turn_rate=0.5)
    found = measure_root_prediction(motion, ToldPath(motion))
    assert max(found.values()) < 0.05
    assert set(found) == {"V1", "V2", "V4", "V8", "V16", "V32", "V64", "Y"}


def test_who_stands_still_misses_the_way_that_is_walked():
    motion = walk(90)
    step = 100 * float(torch.diff(motion.root_position[:, 2]).mean())
    found = measure_root_prediction(motion, StillPath())
    assert found["V1"] == pytest.approx(step, rel=0.05)
    assert found["V64"] == pytest.approx(64 * step, rel=0.05)


def test_a_toe_that_stands_tells_the_way():
    motion = held_toe()
    quats = motion.local_quat_xyzw.clone()
    quats[:, CANONICAL.index("rightUpperLeg")] = torch.tensor([-0.5, 0.0, 0.0, 0.75**0.5]).double()  # is up
    lifted = replace(motion, local_quat_xyzw=quats)
    found = measure_root_prediction(lifted, AnchoredToePath())
    assert found["V32"] < 0.05
    assert found["Y"] < 0.05


def test_rows_by_kind_and_over_all_clips_alike():
    kinds = {"walks": [walk(90), walk(90, turn_rate=0.4)], "short": [walk(20)]}
    rows = benchmark_root_prediction(kinds, tiny_path())
    assert [(row["kind"], row["by"], row["clips"]) for row in rows] == [
        (kind, by, clips)
        for kind, clips in (("walks", 2), ("short", 1), ("all clips", 3))
        for by in ("still", "toe anchored", "ours")
    ]
    assert math.isnan(rows[3]["V32_cm"])
    assert rows[6]["V1_cm"] == pytest.approx((2 * rows[0]["V1_cm"] + rows[3]["V1_cm"]) / 3)
    assert rows[6]["V64_cm"] == rows[0]["V64_cm"]


@pytest.mark.slow
def test_a_clip_walked_in_place_gets_its_way_back_from_who_knows_it():
    motion = walk(80, turn_rate=0.3)
    found = measure_walked_in_place(motion, ToldPath(motion))
    assert found["V64_cm"] < 3
    assert found["planted_cm_s"] < found["mocap_cm_s"]  # the made-up walk slides, and its feet are put down
    still = measure_walked_in_place(motion, StillPath())
    assert still["V64_cm"] > 50
    assert [row["clips"] for row in benchmark_walked_in_place({"walks": [motion, walk(20)]}, tiny_path())] == [1]


def test_the_command_measures_the_clips_that_the_card_holds_out(tmp_path, capsys):
    data = tmp_path / "data"
    (data / "bandai").mkdir(parents=True)
    walk(70).save(data / "bandai" / "a_walk_1.bvh")
    held = {"validation": ["bandai/a_walk_1.bvh"], "test": []}
    path = save_tiny_path(tmp_path / "path.safetensors", held)
    assert run("bench", "tweener", "--part", "path", "--data", data, "--path", path, "--json") == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["kind"], row["clips"]) for row in rows[:3]] == [("walks", 1)] * 3
    missing = save_tiny_path(tmp_path / "other.safetensors", {"validation": ["bandai/gone.bvh"]})
    assert run("bench", "tweener", "--part", "path", "--data", data, "--path", missing) == 2
    assert "does not hold the clips kept from training" in capsys.readouterr().err
