"""Motions that mapctl brings along: `example:NAME` wherever a motion is read."""

import json
import re

import make_example
from helpers import run, walk

import mapctl
from mapctl import formats

NAME = "example:noisy-walk"


def bones(motion) -> dict[str, list[float]]:
    """Offset of each joint below the root, by name; files nest joints in an order of their own."""
    names, offsets = motion.skeleton.names, motion.skeleton.offsets
    return {name: [round(x, 6) for x in offset] for name, offset in zip(names[1:], offsets[1:].tolist(), strict=True)}


def test_it_is_the_walk_of_its_page():
    motion = mapctl.load(NAME)
    assert (motion.num_frames, float(motion.fps)) == (240, 30)
    assert bones(motion) == bones(make_example.performer())
    assert (motion.root_position[-1] - motion.root_position[0]).norm() > 3
    file = formats.resolve_example(NAME)
    assert file.stat().st_size < 300_000
    page = (file.parent / "LICENSE.md").read_text("utf-8")
    assert "free for any use" in page.replace("\n", " ")
    assert {f"{name}.bvh" for name in formats.list_examples()} == set(re.findall(r"^\| `(.+?)`", page, re.M))


def test_other_commands_and_rigs_take_it(tmp_path, capsys):
    assert run("info", NAME, "--json") == 0
    assert json.loads(capsys.readouterr().out)["rig"] == "mixamo"
    assert run("convert", NAME, tmp_path / "part.npz", "--frames", "0:10") == 0
    walk(10).save(tmp_path / "walk.bvh")
    assert run("convert", tmp_path / "walk.bvh", tmp_path / "onto.bvh", "--rig", NAME) == 0
    assert mapctl.load(tmp_path / "onto.bvh").skeleton.names == mapctl.load(NAME).skeleton.names
    assert mapctl.load(tmp_path / "part.npz").licence == formats.EXAMPLES_LICENCE
