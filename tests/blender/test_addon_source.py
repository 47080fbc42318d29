"""The add-on without Blender: its zip, its command, and those of its modules that need no bpy."""

import io
import sys
import tomllib
import types
import zipfile
from fractions import Fraction
from importlib import import_module

import numpy as np
import pytest
import torch
from blender_session import ROOT
from helpers import random_motion, run, walk
from scipy.spatial.transform import Rotation

import mapctl
from mapctl import __version__
from mapctl.commands.blender_addon import build_addon_zip
from mapctl.skeleton import CANONICAL

SOURCE = ROOT / "mapctl" / "blender" / "addon"


@pytest.fixture
def source(monkeypatch):
    """Imports a module of the add-on by its name; the package itself, which imports bpy, is left out."""
    package = types.ModuleType("addon_source")
    package.__path__ = [str(SOURCE)]
    monkeypatch.setitem(sys.modules, "addon_source", package)
    yield lambda name: import_module(f"addon_source.{name}")
    for name in [name for name in sys.modules if name.startswith("addon_source.")]:
        del sys.modules[name]


def test_zip_holds_the_source_and_a_manifest_of_this_version():
    with zipfile.ZipFile(io.BytesIO(build_addon_zip())) as archive:
        names = set(archive.namelist())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        assert archive.read("jobs.py").decode() == (SOURCE / "jobs.py").read_text("utf-8")
    own = [file for file in SOURCE.rglob("*") if file.suffix in (".py", ".toml")]
    assert names == {file.relative_to(SOURCE).as_posix() for file in own}
    assert manifest["version"] == __version__
    assert manifest["blender_version_min"] == "4.2.0"
    assert {"schema_version", "id", "name", "tagline", "maintainer", "type", "license"} <= manifest.keys()


def test_command_writes_the_zip(tmp_path, capsys):
    out = tmp_path / "mapctl-blender.zip"
    assert run("blender-addon", "-o", out) == 0
    assert out.read_bytes() == build_addon_zip()
    assert "Install from Disk" in capsys.readouterr().out


def test_rotations_are_scipys(source):
    rotations = source("exchange")
    turns = Rotation.random(500, rng=0)
    half = Rotation.from_rotvec(np.pi * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.8, 0], [0, 0, 0]]))
    turns = Rotation.concatenate([turns, half])
    assert np.abs(rotations.to_matrices(turns.as_quat()) - turns.as_matrix()).max() < 1e-12
    back = Rotation.from_quat(rotations.to_quaternions(turns.as_matrix()))
    assert (back * turns.inv()).magnitude().max() < 1e-7
    assert (rotations.to_quaternions(turns.as_matrix())[:, 3] >= 0).all()


@pytest.mark.parametrize("motion", [walk(20), random_motion(CANONICAL, 7, seed=3, fps=Fraction(24000, 1001))])
def test_files_are_mapctls(source, tmp_path, motion):
    exchange = source("exchange")
    motion.save(tmp_path / "a.npz")
    held, travelling = exchange.read(tmp_path / "a.npz")
    assert travelling == frozenset()
    assert held.fps == motion.fps
    assert np.abs(held.positions - motion.joint_positions().numpy()).max() < 1e-9
    ends = {"head": held.rest[CANONICAL.index("head")] + np.array([0.0, 0.2, 0.1])}
    exchange.write(held, tmp_path / "b.npz", ends, frozenset(range(21)))
    back = mapctl.load(tmp_path / "b.npz")
    assert back.skeleton.names == motion.skeleton.names
    assert back.fps == motion.fps
    assert torch.allclose(back.joint_positions(), motion.joint_positions(), atol=1e-9)
    assert back.skeleton.end_offsets["head"] == pytest.approx((0.0, 0.2, 0.1))
    assert not back.moving_offsets


def test_joints_that_travel_are_written_where_they_may(source, tmp_path):
    exchange = source("exchange")
    walk(10).save(tmp_path / "a.npz")
    held, _ = exchange.read(tmp_path / "a.npz")
    hand = CANONICAL.index("leftHand")
    held.positions[5, hand] += (0.0, 0.05, 0.0)
    exchange.write(held, tmp_path / "b.npz", {}, frozenset([hand]))
    back = mapctl.load(tmp_path / "b.npz")
    assert set(back.moving_offsets) == {hand}
    assert np.abs(back.joint_positions().numpy()[:, hand] - held.positions[:, hand]).max() < 1e-9
    assert exchange.read(tmp_path / "b.npz")[1] == {hand}
    exchange.write(held, tmp_path / "c.npz", {}, frozenset())
    assert not mapctl.load(tmp_path / "c.npz").moving_offsets


def write_program(folder, text: str) -> str:
    """A program that prints."""
    program = folder / "program"
    program.write_text(f"#!{sys.executable}\n{text}\n")
    program.chmod(0o755)
    return str(program)


def test_mapctl_is_found_by_path_by_preference_and_by_python(source, tmp_path, monkeypatch):
    process = source("process")
    program = write_program(tmp_path, "print('mapctl 0.1.0')")
    assert process.find_command(program) == (program,)
    assert process.find_command(f"{sys.executable} {program}") == (sys.executable, program)
    found = tmp_path / "bin"
    found.mkdir()
    monkeypatch.setenv("PATH", str(found))
    with pytest.raises(source("process").AddonError, match="was not found: pip install mapctl"):
        process.find_command("")
    (found / "python3").write_text('#!/bin/sh\n[ "$1 $2 $3" = "-m mapctl --version" ] && echo mapctl 0.1.0\n')
    (found / "python3").chmod(0o755)
    assert process.find_command("") == (str(found / "python3"), "-m", "mapctl")
    (found / "mapctl").symlink_to(program)
    assert process.find_command("") == (str(found / "mapctl"),)


@pytest.mark.parametrize(
    ("said", "printed"), [("mapctl 0.0.12", "too old"), ("other 1.0", "does not answer like mapctl")]
)
def test_other_programs_are_refused(source, tmp_path, said, printed):
    with pytest.raises(source("process").AddonError, match=printed):
        source("process").find_command(write_program(tmp_path, f"print('{said}')"))
