"""Shots as a user types them: flags of follow, scene files of run, refusals in one line."""

import json

import pytest
import torch
from captures import on_rig
from helpers import run

import mapctl
from mapctl.skeleton import CANONICAL

KEYS = """
[[key]]
seconds = 1.6
look_at = [2.0, 1.4, 2.0]
"""


@pytest.fixture
def keys(tmp_path):
    """A key file."""
    path = tmp_path / "keys.toml"
    path.write_text(KEYS)
    return path


QUALITIES = "feet", "soles", "support", "ground", "acceleration"  # of any motion


@pytest.mark.slow
def test_follow_starts_and_ends_standing_and_reports_every_constraint(keys, tmp_path, capsys):
    out, report = tmp_path / "a.bvh", tmp_path / "a.json"
    words = [
        "--start",
        "stand",
        "--end",
        "stand",
        "--keys",
        keys,
        "--avoid",
        "0.5,0.9,0.2",
        "--fps",
        60,
        "--gait",
        "walk",
    ]
    assert run("follow", "line:1.8", "-o", out, "--report", report, *words) == 0
    said = capsys.readouterr().out
    assert "stand at the end" in said
    motion = mapctl.load(out)
    assert float(motion.fps) == pytest.approx(60, abs=1e-3)
    assert set(motion.skeleton.names) == set(CANONICAL.names)
    found = json.loads(report.read_text())
    names = {constraint["constraint"].split(" at")[0] for constraint in found["constraints"]}
    assert names == {"path", "progress", "obstacles", "look", "stand", "gait walk", *QUALITIES}
    assert all(
        {"asked", "got", "residual", "unit", "holds"} <= constraint.keys() for constraint in found["constraints"]
    )


@pytest.mark.slow
def test_a_scene_goes_on_from_a_clip_on_its_rig_and_keeps_apart(tmp_path):
    on_rig("bandai", 70).save(tmp_path / "clip.bvh")
    (tmp_path / "scene.toml").write_text(
        'outputs = ["a.bvh", "a.json"]\nkeep_apart = 0.6\n'
        '[[actors]]\nname = "on"\nstart = "clip.bvh:60"\ncurve = "line:2"\nspeed = "0:1.0,2:1.2"\nseconds = 1.2\n'
        '[[actors]]\nname = "by"\ncurve = "line:2"\noffset = [3, 0]\nseconds = 1.2\n'
        "[[obstacles]]\nplace = [8, 8]\nsize = [1, 2]\n"
    )
    assert run("run", tmp_path / "scene.toml", "-o", tmp_path / "out", "--quiet") in (0, 3)
    result, clip = mapctl.load(tmp_path / "out" / "a-on.bvh"), mapctl.load(tmp_path / "clip.bvh")
    assert result.skeleton.names == clip.skeleton.names
    miss = (result.joint_positions()[0] - clip.joint_positions()[60]).norm(dim=-1)
    assert float(miss.max()) < 0.01
    report = json.loads((tmp_path / "out" / "a.json").read_text())
    assert [constraint["constraint"] for constraint in report["actors"]["by"]["constraints"]] == [
        "path",
        "progress",
        "obstacles",
        "keep apart",
        *QUALITIES,
    ]


@pytest.mark.slow
def test_a_shot_holds_a_pose_of_another_rig_and_ends_in_a_clip(tmp_path):
    on_rig("bandai", 70).save(tmp_path / "clip.bvh")
    on_rig("cmu", 40).save(tmp_path / "pose.bvh")
    (tmp_path / "keys.toml").write_text(
        f"[[key]]\nseconds = 0.9\npose = '{tmp_path / 'pose.bvh'}'\npose_frame = 20\nwithin_frames = 3\n"
    )
    words = ["--end", f"{tmp_path / 'clip.bvh'}:40", "--keys", tmp_path / "keys.toml"]
    out, report = tmp_path / "a.bvh", tmp_path / "a.json"
    assert run("follow", "line:2.4", "-o", out, "--report", report, *words) == 0
    result, clip = mapctl.load(out), mapctl.load(tmp_path / "clip.bvh")
    assert result.skeleton.names == clip.skeleton.names
    assert float((result.joint_positions()[-1] - clip.joint_positions()[40]).norm(dim=-1).max()) < 0.01
    found = json.loads(report.read_text())
    pose = next(constraint for constraint in found["constraints"] if constraint["constraint"].startswith("pose at"))
    assert pose["holds"]
    assert pose["got"] < 0.1


@pytest.mark.slow
def test_a_loop_leads_into_its_first_frame_at_any_rate(tmp_path):
    out = tmp_path / "a.bvh"
    assert run("follow", "circle:0.8", "-o", out, "--loop", "--fps", 100) == 0
    positions = mapctl.load(out).joint_positions()
    steps = torch.diff(torch.cat([positions, positions[:1]]), dim=0).norm(dim=-1).amax(dim=1)
    assert float(steps[-1]) < 1.2 * float(steps[:-1].max())


def test_variations_are_numbered_and_differ(tmp_path):
    words = ["circle:2", "--seconds", 0.4, "--quiet"]
    assert run("follow", *words, "-o", tmp_path / "a.bvh", "--report", tmp_path / "a.json", "--variations", 3) == 0
    assert run("follow", *words, "-o", tmp_path / "last.bvh", "--seed", 2) == 0
    written = [(tmp_path / f"a_{number:03d}.bvh").read_bytes() for number in range(3)]
    assert len(set(written)) == 3
    assert written[2] == (tmp_path / "last.bvh").read_bytes()
    assert json.loads((tmp_path / "a_002.json").read_text())["seed"] == 2
    scene = tmp_path / "scene.toml"
    scene.write_text('outputs = ["b.npz"]\n[[actors]]\ncurve = "circle:2"\nseconds = 0.4\nseed = 1\n')
    assert run("run", scene, "-o", tmp_path, "--variations", 2, "--quiet") == 0
    found = [mapctl.load(tmp_path / f"b_{number:03d}.npz").root_position for number in range(2)]
    assert not torch.equal(*found)
