"""`mapctl infill --way`: the hips' way told by the body, as a user asks for it, and what is refused."""

import json

import numpy as np
import pytest
from captures import on_rig
from helpers import run
from tiny_infiller import save_tiny_infiller
from tiny_path import save_tiny_path


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return save_tiny_path(tmp_path_factory.mktemp("path") / "tiny.safetensors")


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A walk of 60 frames on a rig with a root on the ground."""
    out = tmp_path_factory.mktemp("clip") / "walk.bvh"
    on_rig("bandai", 60).save(out)
    return out


def channels(file):
    rows = file.read_text().split("Frame Time")[1].splitlines()[1:]
    return np.array([row.split() for row in rows], dtype=float)


@pytest.mark.parametrize("finish", [[], ["--no-refine"]], ids=["map", "raw"])
def test_only_the_hips_place_changes_and_only_there(clip, path, tmp_path, finish):
    out = tmp_path / "out.bvh"
    words = ["--way", "10:20", "--way", "1s:1.5s", "--path", path, "--quiet", *finish]
    assert run("infill", clip, "-o", out, *words) == 0
    before, after = channels(clip), channels(out)
    changed = before != after
    assert set(np.flatnonzero(changed.any(axis=1))) <= {*range(10, 20), *range(30, 45)}
    assert changed[10:20].any(axis=1).sum() >= 8
    assert 1 <= changed.any(axis=0).sum() <= 3


def test_ways_and_gaps_go_together_and_are_told(clip, path, tmp_path, capsys):
    infiller = save_tiny_infiller(tmp_path / "infiller.safetensors", drawn=0.2)
    report, out = tmp_path / "r.json", tmp_path / "out.bvh"
    words = ["--way", "10:40", "--gap", "20:25", "--path", path, "--method", "infiller", "--inbetweener", infiller]
    assert run("infill", clip, "-o", out, *words, "--report", report, "--no-refine") == 0
    assert "10:40" in capsys.readouterr().out
    (gap,) = json.loads(report.read_text())["gaps"]
    assert (gap["start"], gap["stop"], gap["root"]) == (10, 40, True)
    turned = (channels(clip) != channels(out)).sum(axis=1)
    assert turned[20:25].min() > 10
    assert turned[10:20].max() <= 3
