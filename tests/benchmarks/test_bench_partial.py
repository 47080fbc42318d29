"""Keys that are no whole poses: who knows the motion meets them, what is missed is told, and a flat pose is flat."""

import json
import math
from dataclasses import replace

import pytest
import torch
from helpers import run, walk
from test_bench_long_gaps import Told
from tiny_path import save_tiny_path
from tiny_tweener import save_tiny_tweener

from controllers.benchmarks.tweener import partial_keys
from controllers.benchmarks.tweener.gap_measures import Method
from controllers.benchmarks.tweener.partial_keys import benchmark_partial_keys, measure_drawn_pose, tell_keys
from controllers.inbetweening.pipeline import InfillSettings
from controllers.inbetweening.tween import tween
from mapctl.kinematics import heading

RAW = InfillSettings(finish=False)
WHATS = ["halves", "places", "drawings at 0", "drawings at 45", "drawings at 90"]


def test_keys_are_told_every_two_seconds_by_halves_places_and_drawings():
    motion = walk(121, turn_rate=0.3)
    told = tell_keys(motion)
    assert list(told) == WHATS
    assert all(keys.frames == (0, 60, 120) for keys in told.values())
    whats = {name: [(key.what, key.half, key.placed) for key in keys.checked(motion)] for name, keys in told.items()}
    assert whats["halves"] == [("half", "upper", False), ("half", "lower", False), ("half", "upper", False)]
    assert whats["places"] == [("place", None, False)] * 3
    assert whats["drawings at 45"] == [("drawing", None, True)] * 3
    facing = math.degrees(float(heading(motion.local_quat_xyzw[0, 0])))
    drawings = [[key.drawing for key in told[name].checked(motion)] for name in WHATS[2:]]
    views = [[each.view_deg - facing for each in drawn if each is not None] for drawn in drawings]
    assert views == [[pytest.approx(view)] * 3 for view in (0, 45, 90)]


@pytest.mark.parametrize("view", [0, 90])
def test_a_drawn_pose_is_measured_in_its_plane_and_in_space(view):
    """From 0 degrees depth is Z, from 90 it is X."""
    true = torch.tensor([[0.0, 1.0, 0.0], [0.3, 1.0, 0.4]]).double()
    depth = 2 if view == 0 else 0
    deeper, beside = true.clone(), true + 5
    deeper[1, depth] += 0.2
    flat = 100 * abs(float(true[1, depth])) / 2
    assert measure_drawn_pose(deeper, true, view) == pytest.approx((0, 10, flat), abs=1e-6)
    assert measure_drawn_pose(beside, true, view) == pytest.approx((0, 0, flat), abs=1e-6)
    higher = true.clone()
    higher[1, 1] += 0.2
    assert measure_drawn_pose(higher, true, view) == pytest.approx((10, 10, flat), abs=1e-6)


@pytest.mark.slow
def test_who_knows_the_motion_meets_keys_and_who_does_not_is_told(monkeypatch):
    """Drawings of one view will do: to fit poses to them takes a second each."""
    monkeypatch.setattr(partial_keys, "VIEWS_DEG", (45,))
    whats, motion = ["halves", "places", "drawings at 45"], walk(70)
    part = motion.slice(4, 65)
    still = replace(part, local_quat_xyzw=part.local_quat_xyzw[30:31].expand(61, -1, -1).clone())
    methods = [Method("told", Told(part), RAW), Method("still", Told(still), RAW)]
    rows = benchmark_partial_keys({"walks": [motion], "short": [walk(60)]}, methods)
    assert [(row["kind"], row["keys"], row["by"]) for row in rows] == [
        ("walks", what, by) for what in whats for by in ("told", "still")
    ]
    told, still = ({row["keys"]: row for row in rows if row["by"] == by} for by in ("told", "still"))
    assert all(row["missed_cm"] < 0.1 for row in rows)
    assert all(told[what]["error_cm"] < min(0.6, 0.2 * still[what]["error_cm"]) for what in whats)
    assert all(told[what][name] == pytest.approx(1, abs=0.2) for what in whats for name in ("jerk", "step"))
    assert all(still["places"][name] < 0.2 for name in ("jerk", "step"))
    assert len({row["whole_cm"] for row in rows}) == 1
    drawn, missed = told["drawings at 45"], still["drawings at 45"]
    assert drawn["plane_cm"] < drawn["space_cm"] < 0.5 < missed["plane_cm"] < missed["space_cm"]
    assert drawn["flat_cm"] == missed["flat_cm"] > 3
    assert told["halves"]["plane_cm"] is None


def test_a_key_that_is_missed_is_told(monkeypatch):
    """The motion is made 30 cm beside the clip."""
    motion = walk(61)
    monkeypatch.setattr(partial_keys, "VIEWS_DEG", ())

    def go_elsewhere(clip, *args, **settings):
        return tween(replace(clip, root_position=clip.root_position + torch.tensor([0.3, 0, 0])), *args, **settings)

    monkeypatch.setattr(partial_keys, "tween", go_elsewhere)
    rows = benchmark_partial_keys({"walks": [motion]}, [Method("told", Told(motion), RAW)])
    assert [row["missed_cm"] for row in rows] == pytest.approx([30, 30], abs=0.1)


@pytest.mark.slow
def test_the_command_measures_held_out_clips(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(partial_keys, "VIEWS_DEG", (90,))
    whats = ["halves", "places", "drawings at 90"]
    data = tmp_path / "data"
    (data / "bandai").mkdir(parents=True)
    walk(70).save(data / "bandai" / "a_walk_1.bvh")
    predictor = str(save_tiny_path(tmp_path / "path.safetensors"))
    held = {"validation": ["bandai/a_walk_1.bvh"], "test": []}
    saved = save_tiny_tweener(tmp_path / "tweener.safetensors", predictor, held_out=held)
    words = ["--part", "partial", "--tweener", saved, "--path", predictor, "--raw", "--json"]
    assert run("bench", "tweener", "--data", data, *words) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["part"], row["keys"], row["by"]) for row in rows] == [
        ("partial keys", what, str(saved)) for what in whats
    ]
    assert all(row["missed_cm"] < 0.1 and row["error_cm"] > 0 for row in rows)
    assert all(row["plane_cm"] < 3 for row in rows[2:])
