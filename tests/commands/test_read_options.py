"""--unit and --up: what is given is obeyed by every command that reads motions, and what is guessed is doubted."""

import json
from dataclasses import replace

import pytest
import torch
from helpers import run
from rig_maker import Make, make, names_of, person

import mapctl


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A walk on a Z-up rig in centimetres."""
    path = tmp_path_factory.mktemp("rig") / "walk.bvh"
    make(Make(names_of("mixamo"), zup=True, arms_down_deg=40, root="Reference")).motion(person(1.0, 45)).save(path)
    return path


def test_a_body_that_travels_faster_than_people_do_has_a_doubtful_unit(clip, tmp_path, capsys):
    motion = mapctl.load(clip)
    travel = torch.zeros_like(motion.root_position)
    travel[:, 1] = torch.arange(motion.num_frames) * 24.0 / float(motion.fps)
    replace(motion, root_position=motion.root_position + travel).save(tmp_path / "fast.bvh")
    assert run("info", tmp_path / "fast.bvh", "--json") == 0
    assert "m/s for a second: the unit may be wrong" in json.loads(capsys.readouterr().out)["doubts"][0]


@pytest.mark.parametrize("unit", ["in", "0.0254"])
def test_a_given_unit_is_obeyed_by_every_command(clip, unit, tmp_path, capsys):
    assert run("convert", clip, tmp_path / "out.npz", "--unit", unit) == 0
    own, converted = mapctl.load(clip), mapctl.load(tmp_path / "out.npz")
    torch.testing.assert_close(converted.root_position, own.root_position * 2.54)
    assert run("convert", tmp_path / "out.npz", tmp_path / "again.npz", "--unit", unit) == 0  # whose metres are inches
    torch.testing.assert_close(mapctl.load(tmp_path / "again.npz").root_position, 0.0254 * converted.root_position)
    capsys.readouterr()
    heights = []
    for options in ((), ("--unit", unit)):
        assert run("measure", clip, "--json", *options) == 0
        heights.append(json.loads(capsys.readouterr().out)["measures"]["hips_height_m"])
    assert heights[1] == pytest.approx(2.54 * heights[0], rel=1e-3)
    assert run("convert", clip, tmp_path / "out.npz", "--unit", "ell") == 2
    assert "a unit is m, dm, cm, mm, in or metres per unit, got 'ell'" in capsys.readouterr().err


def test_a_given_up_axis_is_obeyed(clip, capsys):
    assert run("info", clip, "--json", "--up", "-x") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["up"], told["rig"], len(told["joints"])) == ("-x", "mixamo", 21)  # its joints are recognised as before


def test_the_unit_is_that_of_a_body_too(clip, prior, tmp_path):
    words = ("--seconds", 0.4, "--prior", prior, "--no-footing", "--quiet", "--to", ".npz")
    assert run("generate", "-o", tmp_path, *words, "--rig", clip, "--unit", "in") == 0
    bones = [mapctl.load(path).skeleton.offsets for path in (tmp_path / "generated_000.npz", clip)]
    torch.testing.assert_close(bones[0][1:], 2.54 * bones[1][1:], atol=1e-4, rtol=0)
