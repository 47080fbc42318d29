"""Edits of `mapctl convert` as a user types them: alone, together, over folders, and what is refused."""

import shutil
from pathlib import Path

import pytest
import torch
from acclaim import pair
from helpers import run, walk

import mapctl
from mapctl import editing
from mapctl.editing.rigged_motion import RiggedMotion

ALL = ("--mirror", "--loop", "--plant-feet")
EDITS = [(), ("--loop",), ("--plant-feet", "--in-place"), ("--mirror", "--root-motion")]
EDITS += [(*ALL, "--in-place"), (*ALL, "--root-motion")]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a walk, and a folder of some."""
    monkeypatch.chdir(tmp_path)
    walk(90, cadence=1.0).save("in.bvh")
    below = tmp_path / "takes" / "day 1"
    below.mkdir(parents=True)
    walk(40).save(below / "a.bvh")
    walk(30).save(below / "b.npz")
    pair(20).write(tmp_path / "takes", subject="01", take="c")
    return tmp_path


@pytest.mark.parametrize("chosen", EDITS, ids=" ".join)
def test_all_go_together(here, capsys, chosen):
    assert run("convert", "in.bvh", "out.bvh", *chosen) == 0
    told, motion = capsys.readouterr(), mapctl.load("out.bvh")
    assert told.err == ""
    assert motion.num_frames == (30 if "--loop" in chosen else 90)
    assert motion.skeleton.names[0] == ("root" if "--root-motion" in chosen else "hips")
    assert ("loop: frames" in told.out, "feet: planted toes" in told.out) == (
        "--loop" in chosen,
        "--plant-feet" in chosen,
    )
    hips = RiggedMotion.of(motion).position("hips")
    assert (float((hips[-1] - hips[0]).norm()) < 0.2) == ("--in-place" in chosen)


def test_edits_come_after_frames_and_rig(here):
    assert run("convert", "takes/01.asf+c.amc", "rig.bvh") == 0
    assert (
        run("convert", "in.bvh", "out.bvh", "--rig", "rig.bvh", "--frames", "10:50", "--mirror", "--root-motion") == 0
    )
    motion = mapctl.load("out.bvh")
    assert motion.num_frames == 40
    assert motion.num_joints == mapctl.load("rig.bvh").num_joints + 1


def test_the_rig_is_that_of_the_whole_clip_where_a_part_does_not_show_it(here):
    assert run("convert", "takes/01.asf+c.amc", "rig.npz") == 0
    assert run("convert", "rig.npz", "cut.npz", "--frames", "5:15", "--mirror") == 0
    assert run("convert", "rig.npz", "whole.npz", "--mirror") == 0
    cut, whole = mapctl.load("cut.npz"), mapctl.load("whole.npz").slice(5, 15)
    torch.testing.assert_close(cut.joint_positions(), whole.joint_positions(), atol=1e-4, rtol=0)


def test_a_folder_becomes_a_folder_with_the_same_names(here, capsys):
    assert run("convert", "takes", "out", "--to", "npz", "--mirror") == 0
    found = sorted(str(path.relative_to("out")) for path in Path("out").rglob("*.*"))
    assert found == ["c.npz", "day 1/a.npz", "day 1/b.npz"]
    assert "3 converted" in capsys.readouterr().out
    wanted = editing.mirror(mapctl.load("takes/day 1/a.bvh")).joint_positions()
    torch.testing.assert_close(mapctl.load("out/day 1/a.npz").joint_positions(), wanted, atol=1e-9, rtol=0)


def test_a_clip_that_fails_stops_no_other_one(here, capsys):
    Path("takes/0.bvh").write_text("HIERARCHY\nnonsense")
    walk(5).save("takes/short.bvh")
    assert run("convert", "takes", "out", "--loop") == 3
    told = capsys.readouterr().out.splitlines()
    assert "failed: takes/0.bvh, line 2" in told[1]
    assert any(line.startswith("failed: takes/short.bvh: no cycle is found") for line in told)
    assert not list(Path("out").rglob("0.*"))


def test_what_is_there_is_done_again_only_if_asked_for(here, capsys):
    assert run("convert", "takes", "out") == 0
    Path("out/c.bvh").write_text("mine")
    assert run("convert", "takes", "out") == 0
    assert "0 converted, 3 there already" in capsys.readouterr().out
    assert Path("out/c.bvh").read_text() == "mine"
    assert run("convert", "takes", "out", "--again", "--quiet") == 0
    assert Path("out/c.bvh").read_text() != "mine"


def test_two_results_of_one_name_and_results_over_what_is_read_are_refused(here, capsys):
    shutil.copy("takes/day 1/a.bvh", "takes/day 1/b.bvh")
    assert run("convert", "takes", "out", "--to", "npz") == 2
    assert "would both become" in capsys.readouterr().err
    Path("takes/day 1/day 1").mkdir()
    walk(5).save("takes/day 1/day 1/z.bvh")
    walk(5).save("takes/z.bvh")
    before = {path: path.read_bytes() for path in Path("takes").rglob("*.*")}
    assert run("convert", "takes/day 1", "takes") in (0, 2)
    after = {path: path.read_bytes() for path in before}
    assert before == after
