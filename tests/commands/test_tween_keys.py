"""`mapctl tween KEYS.toml` as a user types it: keys of every kind, suggested timing, and what is refused."""

import json
import re
from pathlib import Path

import pytest
from captures import on_rig
from helpers import run, walk
from methods import words_of
from tiny_infiller import save_tiny_infiller

import mapctl
from mapctl import retarget

DOCS = Path(__file__).parents[2] / "docs" / "inputs"
GOOD = """
body = "walk.bvh"
[[key]]
frame = 0
[[key]]
seconds = 0.5
reach = { Hand_L = [0.4, 1.2, 0.8] }
[[key]]
frame = 22
pose = "other.bvh"
pose_frame = 20
root_only = true
[[key]]
frame = 40
pose_frame = 40
place = [0.3, 1.5]
facing_deg = 30
"""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return save_tiny_infiller(tmp_path_factory.mktemp("infiller") / "tiny.safetensors", drawn=0.02)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Poses and keys beside them; the current folder is another."""
    (tmp_path / "keys").mkdir()
    (tmp_path / "here").mkdir()
    on_rig("bandai", 45).save(tmp_path / "keys" / "walk.bvh")
    on_rig("daz", 45).save(tmp_path / "keys" / "other.bvh")
    (tmp_path / "keys" / "keys.toml").write_text(GOOD)
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


@pytest.fixture
def models(tiny, prior):
    """By method, the options that name what it needs."""
    return {"auto": ["--inbetweener", tiny, "--prior", prior], "infiller": ["--inbetweener", tiny], "slerp": []}


@pytest.fixture
def tween(models):
    """Runs the command; returns the exit status."""
    return lambda *words: run("tween", *words, *models["auto"])


def test_keys_of_every_kind_are_met_in_the_file(tween, folder, capsys):
    words = [folder / "keys" / "keys.toml", "-o", "out.bvh", "--report", "r.json"]
    assert tween(*words) == 0
    assert capsys.readouterr().out.startswith("out.bvh: 41 frames through 4 keys; ")
    result = mapctl.load("out.bvh")
    assert (result.num_frames, float(result.fps)) == (41, 30)
    assert result.skeleton.names == mapctl.load(folder / "keys" / "walk.bvh").skeleton.names
    assert result.root_position.isfinite().all()
    printed = json.loads(Path("r.json").read_text())
    assert [(row["frame"], row["what"]) for row in printed["keys"]] == [
        (0, "pose"),
        (15, "limbs"),
        (22, "root"),
        (40, "pose"),
    ]
    assert all(row["missed_cm"] < 0.1 for row in printed["keys"])
    canonical = retarget.to_canonical(result)[0]
    hand = canonical.joint_positions()[15, canonical.skeleton.index("leftHand")]
    assert hand.tolist() == pytest.approx([0.4, 1.2, 0.8], abs=2e-3)
    assert canonical.root_position[40, ::2].tolist() == pytest.approx([0.3, 1.5], abs=1e-4)
    assert "key_timing" not in printed


def test_timing_is_suggested_and_the_given_one_made(folder, capsys):
    keys = folder / "keys" / "keys.toml"
    words = [*words_of("slerp"), "--suggest-timing", "--report", "r.json"]
    assert run("tween", keys, "-o", "out.bvh", *words) == 0
    assert mapctl.load("out.bvh").num_frames == 41
    (row,) = json.loads(Path("r.json").read_text())["key_timing"]
    assert (row["start"], row["stop"], row["given"]) == (0, 40, 40)
    assert row["usual"][0] <= row["suggested"] <= row["usual"][1]
    printed = capsys.readouterr().out
    assert re.search(rf"\b0 +40 +40 +{row['suggested']} +\w+", printed)
    assert "m/s" in printed


@pytest.mark.parametrize("method", ["slerp", *(pytest.param(m, marks=pytest.mark.slow) for m in ("auto", "bundled"))])
def test_the_example_runs_on_a_clip_of_its_name(models, tiny, folder, method):
    """The clip that it names is written by the command that it names; of the bundled densities the default ones
    roll."""
    text = (DOCS / "keys.toml").read_text()
    (named,) = set(re.findall(r'"([\w/]+\.bvh)"', text))
    clip = folder / "keys" / named
    clip.parent.mkdir(exist_ok=True)
    walk(120).save(clip)
    (folder / "keys" / "example.toml").write_text(text)
    words = (folder / "keys" / "example.toml", "-o", "out.bvh", "--report", "r.json", "--quiet")
    more = ["--inbetweener", tiny] if method == "bundled" else ["--method", method, *models[method]]
    assert run("tween", *words, *more) == 0
    printed = json.loads(Path("r.json").read_text())
    assert {row["what"] for row in printed["keys"]} == {"pose", "limbs", "root"}


PARTS = """
body = "walk.bvh"
[[key]]
frame = 0
root_only = "place"
place = [0, 0]
[[key]]
frame = 20
drawing = "pose.csv"
view_deg = 90
[[key]]
frame = 40
pose_frame = 40
half = "lower"
"""
DRAWING = "joint,x,y\nHips,3,98\nHead,4,160\nHand_L,30,130\nrightHand,0,80\nFoot_L,10,12\nFoot_R,-8,12\n"


@pytest.mark.parametrize("method", ["tweener", pytest.param("auto", marks=pytest.mark.slow)])
def test_keys_that_are_not_whole_are_met_in_the_file(models, folder, method):
    """The first of them has but a position."""
    (folder / "keys" / "keys.toml").write_text(PARTS)
    (folder / "keys" / "pose.csv").write_text(DRAWING)
    more = ["--method", "tweener", "--no-refine"] if method == "tweener" else models["auto"]
    words = [folder / "keys" / "keys.toml", "-o", "out.bvh", "--report", "r.json", "--quiet"]
    assert run("tween", *words, *more) == 0
    first, drawn, half = json.loads(Path("r.json").read_text())["keys"]
    assert [row["what"] for row in (first, drawn, half)] == ["place", "drawing", "half"]
    assert first["missed_cm"] < 0.1
    assert half["missed_cm"] < 0.1
    assert drawn["drawn_cm"] < 3
    result, walked = mapctl.load("out.bvh"), mapctl.load(folder / "keys" / "walk.bvh")
    canonical = [retarget.to_canonical(each)[0] for each in (result, walked)]
    assert canonical[0].root_position[0, ::2].tolist() == pytest.approx([0, 0], abs=1e-4)
    legs = [number for number, name in enumerate(canonical[0].skeleton.names) if "Leg" in name]
    turns = [each.local_quat_xyzw[40, legs] for each in canonical]
    assert (turns[0] * turns[1]).sum(dim=-1).abs().min() > 1 - 1e-6
