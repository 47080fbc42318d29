"""`mapctl infill` as a user types it: files, gaps, reports, and what is refused."""

import json

import numpy as np
import pytest
from captures import on_rig
from helpers import run
from methods import words_of
from tiny_infiller import save_tiny_infiller

import mapctl

NAMES = {"canonical": "leftHand", "bandai": "Hand_L", "daz": "lHand"}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return save_tiny_infiller(tmp_path_factory.mktemp("infiller") / "tiny.safetensors", drawn=0.2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Files of walks by rig and rate, 1.5 seconds each."""
    folder, made = tmp_path_factory.mktemp("recording"), {}

    def of(rig="bandai", fps=30):
        if (rig, fps) not in made:
            made[rig, fps] = folder / f"{rig}-{fps}.bvh"
            on_rig(rig, round(1.5 * fps), fps=fps).save(made[rig, fps])
        return made[rig, fps]

    return of


@pytest.fixture
def infill(tiny):
    """Runs the command, with the tiny network where the method asks one; returns the exit status."""
    return lambda *words: run("infill", *words, *([] if "slerp" in words else ["--inbetweener", tiny]))


def rows(path):
    """The lines of the frames, as text."""
    return path.read_text().split("Frame Time")[1].splitlines()[1:]


def spoilt(source, out, *gaps):
    """The file with nonsense in the gaps."""
    lines, draw = source.read_text().splitlines(), np.random.default_rng(0)
    first = next(number for number, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    for start, stop in gaps:
        for frame in range(first + start, first + stop):
            lines[frame] = " ".join(f"{value:.3f}" for value in draw.uniform(-170, 170, len(lines[frame].split())))
    out.write_text("\n".join(lines) + "\n")
    return out


@pytest.mark.parametrize(
    ("rig", "fps", "method"), [("bandai", 60, "infiller"), ("daz", 30, "slerp"), ("bandai", 30, "auto")]
)
def test_outside_the_gap_every_channel_is_as_it_was(infill, recording, tmp_path, rig, fps, method):
    """In the text of the file, also where what is filled in turns about."""
    source, out = recording(rig, fps), tmp_path / "out.bvh"
    assert infill(source, "-o", out, "--gap", f"{fps // 2}:{fps}", *words_of(method), "--quiet") == 0
    before, after = rows(source), rows(out)
    same = [one == other for one, other in zip(before, after, strict=True)]
    assert same == [not fps // 2 <= frame < fps for frame in range(len(before))]


@pytest.mark.parametrize(("rig", "method"), [("bandai", "auto"), ("daz", "infiller")])
def test_what_stands_in_the_gap_does_not_matter(infill, recording, tmp_path, rig, method):
    found, gaps = set(), ((10, 15), (22, 30))
    wild = spoilt(recording(rig), tmp_path / "wild.bvh", *gaps)
    words = [word for gap in gaps for word in ("--gap", "{}:{}".format(*gap))]
    for source in (recording(rig), wild):
        assert infill(source, "-o", tmp_path / "out.bvh", *words, *words_of(method), "--quiet") == 0
        found.add((tmp_path / "out.bvh").read_bytes())
    assert len(found) == 1


def test_several_gaps_in_frames_and_seconds_are_told(infill, recording, tmp_path, capsys):
    out = tmp_path / "out.npz"
    assert infill(recording(), "-o", out, "--gap", "1s:1.2s", "--gap", "10:15", *words_of("infiller")) == 0
    told = capsys.readouterr()
    assert f"{out}: 45 frames at 30 a second; filled 10:15 (22 joints), 30:36 (22 joints);" in told.out
    assert told.err == ""
    assert mapctl.load(out).num_frames == 45


@pytest.mark.parametrize(("rig", "gap"), [("canonical", ()), ("bandai", ("--gap", "20:30")), ("daz", ())])
def test_lost_joints_with_and_without_gaps(infill, recording, tmp_path, rig, gap):
    source, out, report = recording(rig), tmp_path / "out.bvh", tmp_path / "r.json"
    words = ["--joints", NAMES[rig], *gap, *words_of("infiller"), "--report", report, "--quiet"]
    assert infill(source, "-o", out, *words) == 0
    (found,) = json.loads(report.read_text())["gaps"]
    assert (found["start"], found["stop"]) == ((20, 30) if gap else (0, 45))
    assert (found["joints"], found["root"]) == (2, False)
    before, after = (np.array([row.split() for row in rows(path)], dtype=float) for path in (source, out))
    changed = (before != after).any(axis=0).sum()
    assert 1 <= changed <= 6  # of the hand and the lower arm
    if gap:
        assert (before == after).all(axis=1).sum() == 35


def test_frozen_frames_are_found(infill, recording, tmp_path, capsys):
    lines = recording().read_text().splitlines()
    lines[-25:-15] = [lines[-26]] * 10
    (tmp_path / "frozen.bvh").write_text("\n".join(lines) + "\n")
    assert infill(tmp_path / "frozen.bvh", "-o", tmp_path / "out.bvh", *words_of("infiller")) == 0
    assert "filled 20:30 (22 joints);" in capsys.readouterr().out
