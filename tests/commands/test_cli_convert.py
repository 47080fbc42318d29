"""`mapctl convert` between all formats, as a user types it, and what docs/guides/formats.md says of them."""

import contextlib
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from acclaim import pair
from character_maker import make_character_glb
from direct_readers import read_directly
from fbx_maker import make_fbx
from helpers import run, walk

import mapctl
from mapctl import formats, retarget
from mapctl.formats import USD_WRITTEN

needs_usd = pytest.mark.skipif(not find_spec("pxr"), reason="needs usd-core: pip install 'mapctl[usd]'")
needs_ufbx = pytest.mark.skipif(find_spec("ufbx") is None, reason="needs ufbx: pip install 'mapctl[fbx]'")


def _mark(source, ending):
    """All pairs that have .bvh among them are quick enough together."""
    needed = {".usd": needs_usd, ".fbx": needs_ufbx}
    marks = [needed[part[:4]] for part in (source, ending) if part[:4] in needed]
    return pytest.param(source, ending, marks=marks if ".bvh" in (source, ending) else [*marks, pytest.mark.slow])


PAIRS = [_mark(source, ending) for source in formats.READERS for ending in formats.WRITERS]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a walk in every format that is read."""
    here = tmp_path_factory.mktemp("formats")
    with contextlib.chdir(here):
        _write_all(here)
    return here


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
    if find_spec("pxr"):
        from pxr import UsdUtils

        for ending in USD_WRITTEN:
            motion.save(f"in{ending}")
        assert UsdUtils.CreateNewUsdzPackage("in.usdc", "in.usdz")


@pytest.fixture
def here(folder, tmp_path, monkeypatch):
    """The current folder, with that walk."""
    for file in folder.iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    with read_directly():
        yield tmp_path


@pytest.mark.parametrize(("source", "ending"), PAIRS)
def test_any_format_to_any_format(here, capsys, source, ending):
    if ending == ".vrma" and source not in (".vrm", ".vrma"):
        assert run("convert", f"in{source}", "out.vrma") == 0
        made, wanted = mapctl.load("out.vrma"), retarget.to_canonical(mapctl.load(f"in{source}"))[0]
        at = [made.skeleton.index(name) for name in wanted.skeleton.names]
        np.testing.assert_allclose(made.joint_positions()[:, at], wanted.joint_positions(), atol=5e-6)
        return
    if ending == ".vrm" and source != ".vrm":
        assert run("convert", f"in{source}", "out.vrm") == 2
        assert "a .vrm needs a character" in capsys.readouterr().err
        return
    assert run("convert", f"in{source}", f"out{ending}") == 0
    told = capsys.readouterr()
    motion = mapctl.load(f"in{source}")
    assert told.err == "" or source == ".amc"  # whose random angles are doubtful
    assert told.out.startswith(
        f"out{ending}: 6 frames, {motion.num_joints} joints, {float(motion.fps):g} frames a second"
    )
    again = mapctl.load(f"out{ending}")
    names = [name for name in motion.skeleton.names if ending != ".vrma" or name in again.skeleton.names]  # bones alone
    where, there = ([one.skeleton.index(name) for name in names] for one in (again, motion))  # BVH nests depth first
    np.testing.assert_allclose(again.joint_positions()[:, where], motion.joint_positions()[:, there], atol=5e-6)
    assert Path(f"out{ending}").stat().st_size > 1000


def test_a_capture_says_its_rate_on_the_command_line(here):
    assert run("convert", "01.asf+in.amc", "out.npz", "--fps-in", "60", "--fps", "30") == 0
    motion = mapctl.load("out.npz")
    assert (motion.fps, motion.num_frames) == (30, 3)
    np.testing.assert_allclose(motion.joint_positions(), mapctl.load("in.amc").joint_positions()[::2], atol=1e-9)


@pytest.mark.parametrize("frames", ["2:5", "0.0667s:0.1667s"])
@pytest.mark.parametrize("source", ["in.bvh", "in.npz"])
def test_some_frames_alone(here, source, frames):
    """In the layout of the whole."""
    assert run("convert", source, "out.bvh", "--frames", frames) == 0
    some, whole = mapctl.load("out.bvh"), mapctl.load(source)
    assert (some.num_frames, some.fps, some.skeleton.names) == (3, whole.fps, mapctl.load("in.bvh").skeleton.names)
    where = [some.skeleton.index(name) for name in whole.skeleton.names]
    np.testing.assert_allclose(some.joint_positions()[:, where], whole.joint_positions()[2:5], atol=2e-6)


def test_frames_are_picked_before_the_rate_is_changed(here):
    assert run("convert", "in.bvh", "out.npz", "--frames", "1:6", "--fps", "15") == 0
    picked = mapctl.load("in.bvh").slice(1, 6).resample(15)
    np.testing.assert_allclose(mapctl.load("out.npz").joint_positions(), picked.joint_positions(), atol=1e-9)


@pytest.mark.parametrize(
    "words", ["--rig canonical", "--rig mixamo", "--root-motion", "--fps 20", "--mirror", "--in-place"]
)
def test_a_licence_outlives_what_is_done_to_the_motion(here, words):
    formats.save(replace(walk(40), licence="CC BY 4.0 (somebody)"), "given.npz")
    assert run("convert", "given.npz", "out.npz", *words.split()) == 0
    assert mapctl.load("out.npz").licence == "CC BY 4.0 (somebody)"
