"""`mapctl convert` as a user types it: between all formats, edits of the motion, folders."""

import contextlib
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from acclaim import pair
from blender_session import PYTHON, needs_blender
from character_maker import make_character_glb
from direct_readers import read_directly
from fbx_maker import make_fbx
from helpers import make_smpl_parameters, run, walk
from marker_files import MARKED, write_markers

import mapctl
from mapctl import editing, formats, retarget
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.formats import USD_WRITTEN
from mapctl.formats.fbx_out import BLENDER

needs_usd = pytest.mark.skipif(not find_spec("pxr"), reason="needs usd-core: pip install 'mapctl[usd]'")
needs_ezc3d = pytest.mark.skipif(find_spec("ezc3d") is None, reason="needs ezc3d: pip install 'mapctl[c3d]'")
needs_ufbx = pytest.mark.skipif(find_spec("ufbx") is None, reason="needs ufbx: pip install 'mapctl[fbx]'")


def _mark(source, ending):
    """All pairs that have .bvh among them are quick enough together."""
    needed = {".usd": needs_usd, ".fbx": needs_ufbx, ".c3d": needs_ezc3d}
    marks = [needed[part[:4]] for part in (source, ending) if part[:4] in needed]
    quick = ".bvh" in (source, ending) and ending != ".fbx"
    marks += [needs_blender] if ending == ".fbx" else []
    return pytest.param(source, ending, marks=marks if quick else [*marks, pytest.mark.slow])


PAIRS = [_mark(source, ending) for source in formats.READERS for ending in formats.WRITERS]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a walk in every format that is read."""
    every_format = tmp_path_factory.mktemp("formats")
    with contextlib.chdir(every_format):
        _write_all(every_format)
    return every_format


def _write_all(folder):
    motion = walk(6)
    motion.save("in.bvh")
    motion.save("in.npz")
    pair(6).write(folder, subject="01", take="in")
    motion.save("in.glb")
    make_character_glb("in.gltf", animations=("walk",), frames=6)
    make_character_glb("in.vrm", names="vrm", animations=("walk",), frames=6)
    make_character_glb("given.vrm", names="vrm", animations=("walk",), frames=6)
    mapctl.load("given.vrm").save("in.vrma")
    make_fbx("in.fbx", skin=False, frames=6)
    for name in ("in.pt", "in.pth"):
        torch.save(make_smpl_parameters(6), name)
    for ending in MARKED:
        if ending != ".c3d" or find_spec("ezc3d"):
            write_markers(folder / f"in{ending}", motion)
    if find_spec("pxr"):
        from pxr import UsdUtils

        for ending in USD_WRITTEN:
            motion.save(f"in{ending}")
        assert UsdUtils.CreateNewUsdzPackage("in.usdc", "in.usdz")


@pytest.fixture
def every_format(folder, tmp_path, monkeypatch):
    """The current folder, with that walk."""
    for file in folder.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(BLENDER, str(PYTHON))
    with read_directly():
        yield tmp_path


@pytest.mark.parametrize(("source", "ending"), PAIRS)
def test_any_format_to_any_format(every_format, capsys, source, ending):
    if ending == ".vrma" and source not in (".vrm", ".vrma"):
        assert run("convert", f"in{source}", "out.vrma") == 0
        result, wanted = mapctl.load("out.vrma"), retarget.to_canonical(mapctl.load(f"in{source}"))[0]
        at = [result.skeleton.index(name) for name in wanted.skeleton.names]
        np.testing.assert_allclose(result.joint_positions()[:, at], wanted.joint_positions(), atol=5e-6)
        return
    if ending == ".vrm" and source != ".vrm":
        assert run("convert", f"in{source}", "out.vrm") == 2
        assert "a .vrm needs a character" in capsys.readouterr().err
        return
    assert run("convert", f"in{source}", f"out{ending}") == 0
    printed = capsys.readouterr()
    motion = mapctl.load(f"in{source}")
    # random angles are doubtful, SMPL has no bones, names of joints are assumed
    assert printed.err == "" or source in (".amc", ".pt", ".pth", ".npy")
    assert printed.out.startswith(
        f"out{ending}: 6 frames, {motion.num_joints} joints, {float(motion.fps):g} frames a second"
    )
    again = mapctl.load(f"out{ending}")
    names = [name for name in motion.skeleton.names if ending != ".vrma" or name in again.skeleton.names]  # bones alone
    where, there = ([one.skeleton.index(name) for name in names] for one in (again, motion))  # BVH nests depth first
    near = 2e-5 if ending == ".fbx" else 5e-6  # Blender's poses have single precision
    np.testing.assert_allclose(again.joint_positions()[:, where], motion.joint_positions()[:, there], atol=near)
    assert Path(f"out{ending}").stat().st_size > 1000


def test_a_captures_rate_is_printed(every_format):
    assert run("convert", "01.asf+in.amc", "out.npz", "--fps-in", "60", "--fps", "30") == 0
    motion = mapctl.load("out.npz")
    assert (motion.fps, motion.num_frames) == (30, 3)
    np.testing.assert_allclose(motion.joint_positions(), mapctl.load("in.amc").joint_positions()[::2], atol=1e-9)


@pytest.mark.parametrize("frames", ["2:5", "0.0667s:0.1667s"])
@pytest.mark.parametrize("source", ["in.bvh", "in.npz"])
def test_some_frames_alone(every_format, source, frames):
    """In the layout of the whole."""
    assert run("convert", source, "out.bvh", "--frames", frames) == 0
    some, whole = mapctl.load("out.bvh"), mapctl.load(source)
    assert (some.num_frames, some.fps, some.skeleton.names) == (3, whole.fps, mapctl.load("in.bvh").skeleton.names)
    where = [some.skeleton.index(name) for name in whole.skeleton.names]
    np.testing.assert_allclose(some.joint_positions()[:, where], whole.joint_positions()[2:5], atol=2e-6)


def test_frames_are_picked_before_the_rate_is_changed(every_format):
    assert run("convert", "in.bvh", "out.npz", "--frames", "1:6", "--fps", "15") == 0
    picked = mapctl.load("in.bvh").slice(1, 6).resample(15)
    np.testing.assert_allclose(mapctl.load("out.npz").joint_positions(), picked.joint_positions(), atol=1e-9)


@pytest.mark.parametrize(
    "words", ["--rig canonical", "--rig mixamo", "--root-motion", "--fps 20", "--mirror", "--in-place"]
)
def test_a_licence_outlives_what_is_done_to_the_motion(every_format, words):
    formats.save(replace(walk(40), licence="CC BY 4.0 (a studio)"), "given.npz")
    assert run("convert", "given.npz", "out.npz", *words.split()) == 0
    assert mapctl.load("out.npz").licence == "CC BY 4.0 (a studio)"


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
    printed, motion = capsys.readouterr(), mapctl.load("out.bvh")
    assert printed.err == ""
    assert motion.num_frames == (30 if "--loop" in chosen else 90)
    assert motion.skeleton.names[0] == ("root" if "--root-motion" in chosen else "hips")
    assert ("loop: frames" in printed.out, "feet: planted toes" in printed.out) == (
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
    printed = capsys.readouterr().out.splitlines()
    assert "failed: takes/0.bvh, line 2" in printed[1]
    assert any(line.startswith("failed: takes/short.bvh: no cycle is found") for line in printed)
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
