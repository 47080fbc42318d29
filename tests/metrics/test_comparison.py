"""Measures that mean the same whatever the frame rate, the axis that points up and the rig of the file."""

import json
import math
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from captures import trembling
from helpers import random_motion, run, walk

from mapctl import metrics
from mapctl.metrics import make_comparable
from mapctl.motion import Motion
from mapctl.retarget import UNKNOWN_RIG_NOTE, put_upright
from mapctl.skeleton import Skeleton

TREMOR = math.radians(0.3)


def told(capsys, *words: object) -> dict:
    assert run("measure", *words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def trembling_walk(fps: int) -> Motion:
    """Ten seconds with noise that is as large in every frame at any rate."""
    return trembling(walk(10 * fps + 1, fps=fps), TREMOR, seed=fps)


def thinned(motion: Motion, step: int) -> Motion:
    """Every so manieth frame."""
    return Motion(motion.skeleton, motion.fps / step, motion.root_position[::step], motion.local_quat_xyzw[::step])


@pytest.mark.parametrize("fps", [60, 120, 240])
@pytest.mark.parametrize("folder", [False, True])
def test_faster_files_are_measured_at_the_rate_of_mocaps_values(fps, folder, tmp_path, capsys):
    trembling_walk(fps).save(tmp_path / "fast.bvh")
    values = told(capsys, tmp_path if folder else tmp_path / "fast.bvh")
    usual = metrics.measure(thinned(trembling_walk(fps), fps // 30))
    assert values["measures"] == pytest.approx(usual, rel=0.02, abs=0.01)
    assert metrics.measure(trembling_walk(fps))["jitter_m_s3"] > 3 * usual["jitter_m_s3"]
    assert values["notes"] == []


@pytest.mark.parametrize(("fps", "said"), [(Fraction(30000, 1001), False), (Fraction(24), True), (Fraction(15), True)])
def test_slower_files_stay_as_they_are_and_that_is_said(fps, said):
    motion = replace(walk(60), fps=fps)
    comparable, notes = make_comparable(motion)
    assert comparable.num_frames == 60
    assert bool(notes) == said
    assert all("frames a second" in note for note in notes)


def unknown() -> Motion:
    """A skeleton that is no body but has hips, feet and thighs by name."""
    names = ("Hips", "LeftUpLeg", "LeftFoot", "RightUpLeg", "RightFoot")
    offsets = torch.tensor([[0, 0, 0], [0.1, 0, 0], [0, -0.8, 0], [-0.1, 0, 0], [0, -0.8, 0]], dtype=torch.float64)
    return random_motion(Skeleton(names, (-1, 0, 1, 0, 3), offsets), 40)


def test_what_is_not_known_of_a_rig_is_said_in_one_line(tmp_path, capsys):
    unknown().save(tmp_path / "a.bvh")
    values = told(capsys, tmp_path / "a.bvh")
    assert values["notes"] == [f"{tmp_path / 'a.bvh'}: {UNKNOWN_RIG_NOTE}"]
    assert values["measures"]["jitter_m_s3"] == pytest.approx(metrics.measure(unknown())["jitter_m_s3"], rel=1e-3)
    assert run("measure", tmp_path / "a.bvh") == 0
    assert UNKNOWN_RIG_NOTE in capsys.readouterr().out
    assert put_upright(unknown())[1] == (UNKNOWN_RIG_NOTE,)
