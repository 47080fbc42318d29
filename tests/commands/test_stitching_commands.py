"""Stitched gaps through the command line."""

import json
from pathlib import Path

import pytest
import torch
from helpers import run, walk
from tiny_prior import save_tiny_prior
from tiny_stitcher import save_tiny_stitcher

from mapctl import formats


@pytest.fixture
def clip(tmp_path, monkeypatch):
    """A folder with a clip, a stitcher and a density."""
    monkeypatch.chdir(tmp_path)
    formats.save(walk(40), tmp_path / "clip.bvh")
    save_tiny_stitcher(tmp_path / "own.safetensors")
    save_tiny_prior(tmp_path / "prior.safetensors")
    return "clip.bvh"


STITCH = ("--method", "stitcher", "--stitcher", "own.safetensors", "--no-refine", "--quiet")


@pytest.mark.slow
def test_one_transition_and_its_report(clip):
    assert run("tween", clip, "-o", "one.bvh", "--keyframes", "0,20,39", *STITCH, "--report", "one.json") == 0
    report = json.loads(Path("one.json").read_text())
    assert report["fallback"] == []
    assert report["sides_apart_cm"] > 0
    assert report["gap_notes"] == ["frames 1:20, 21:39: stitcher"]
    result, given = (formats.load(name) for name in ("one.bvh", clip))
    torch.testing.assert_close(result.root_position[[0, 20, 39]], given.root_position[[0, 20, 39]], atol=1e-6, rtol=0)
    assert float((result.root_position - given.root_position)[1:20].norm(dim=-1).max()) > 1e-4


@pytest.mark.slow
def test_the_first_variation_is_the_calm_one_and_the_others_are_the_same_however_many(clip):
    words = ("tween", clip, "--keyframes", "0,20", *STITCH, "--prior", "prior.safetensors", "--seed", "3")
    words = tuple(word for word in words if word != "--no-refine")
    for out, count in (("few.bvh", 2), ("many.bvh", 4)):
        assert run(*words, "-o", out, "--variations", count) == 0
    assert run(*words[:-2], "-o", "one.bvh") == 0
    same = [("few_000.bvh", "one.bvh"), ("few_000.bvh", "many_000.bvh"), ("few_001.bvh", "many_001.bvh")]
    for one, other in same:
        assert Path(one).read_bytes() == Path(other).read_bytes(), (one, other)
    assert len({Path(f"many_00{number}.bvh").read_bytes() for number in range(4)}) == 4


def test_infill_and_chain_stitch(clip):
    assert run("infill", clip, "-o", "whole.bvh", "--gap", "10:25", *STITCH, "--report", "whole.json") == 0
    assert json.loads(Path("whole.json").read_text())["gap_notes"] == ["frames 10:25: stitcher"]
    assert run("chain", clip, clip, "-o", "long.bvh", "--piece", 12, "--gap", "8:10", *STITCH) == 0
    assert formats.load("long.bvh").num_frames >= 32


def test_a_gap_that_is_too_long_is_anothers_and_the_note_says_so(clip, capsys):
    words = ("tween", clip, "-o", "one.bvh", "--keyframes", "0,30", *STITCH)
    assert run(*(word for word in words if word != "--quiet")) == 0
    printed = capsys.readouterr().out
    assert "frames 1:30: transformer" in printed
    assert "longer than the 23 frames that the stitcher fills" in printed


@pytest.mark.slow
def test_auto_stitches_where_a_hand_is_told(clip, capsys):
    words = ("tween", clip, "-o", "one.bvh", "--no-refine", "--stitcher", "own.safetensors", "--joints", "leftHand")
    assert run(*words, "--keyframes", "0,10,20") == 0
    assert "frames 1:20: stitcher, led by the constraints in it" in capsys.readouterr().out
    assert run(*words, "--keyframes", "0,10,30") == 0
    printed = capsys.readouterr().out
    assert "frames 1:30: transformer" in printed
    assert "longer than the 23 frames that the stitcher fills" in printed
