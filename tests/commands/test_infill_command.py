"""`mapctl infill` as a user types it: gaps, lost joints, files with NaN, root trajectories, reports."""

import json

import numpy as np
import pytest
from captures import on_rig
from helpers import run
from lossy_files import archive_without, with_all_channels, without
from methods import words_of
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller
from tiny_path import save_tiny_path

import mapctl

HANDS = {"canonical": "leftHand", "bandai": "Hand_L", "daz": "lHand"}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return save_tiny_infiller(tmp_path_factory.mktemp("infiller") / "tiny.safetensors", drawn=0.2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Files of walks by rig and rate, 1.5 seconds each."""
    folder, result = tmp_path_factory.mktemp("recording"), {}

    def of(rig="bandai", fps=30):
        if (rig, fps) not in result:
            result[rig, fps] = folder / f"{rig}-{fps}.bvh"
            on_rig(rig, round(1.5 * fps), fps=fps).save(result[rig, fps])
        return result[rig, fps]

    return of


@pytest.fixture
def infill(tiny):
    """Runs the command, with the tiny network where the method asks one; returns the exit status."""
    return lambda *words: run("infill", *words, *([] if "slerp" in words else ["--inbetweener", tiny]))


def rows(path):
    """The lines of the frames, as text."""
    return path.read_text().split("Frame Time")[1].splitlines()[1:]


def corrupted(source, out, *gaps):
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
    wild = corrupted(recording(rig), tmp_path / "wild.bvh", *gaps)
    words = [word for gap in gaps for word in ("--gap", "{}:{}".format(*gap))]
    for source in (recording(rig), wild):
        assert infill(source, "-o", tmp_path / "out.bvh", *words, *words_of(method), "--quiet") == 0
        found.add((tmp_path / "out.bvh").read_bytes())
    assert len(found) == 1


def test_several_gaps_in_frames_and_seconds_are_printed(infill, recording, tmp_path, capsys):
    out = tmp_path / "out.npz"
    assert infill(recording(), "-o", out, "--gap", "1s:1.2s", "--gap", "10:15", *words_of("infiller")) == 0
    printed = capsys.readouterr()
    assert f"{out}: 45 frames at 30 a second; filled 10:15 (22 joints), 30:36 (22 joints);" in printed.out
    assert printed.err == ""
    assert mapctl.load(out).num_frames == 45


@pytest.mark.parametrize(("rig", "gap"), [("canonical", ()), ("bandai", ("--gap", "20:30")), ("daz", ())])
def test_lost_joints_with_and_without_gaps(infill, recording, tmp_path, rig, gap):
    source, out, report = recording(rig), tmp_path / "out.bvh", tmp_path / "r.json"
    words = ["--joints", HANDS[rig], *gap, *words_of("infiller"), "--report", report, "--quiet"]
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


NAMES = {"canonical": ("leftHand", "rightLowerLeg"), "bandai": ("Hand_L", "LowerLeg_R"), "daz": ("lHand", "rShin")}


@pytest.fixture
def infilled(tiny, tmp_path):
    """Runs the command, which must do; returns the text of what it writes."""

    def result(source, *words, method="infiller"):
        asked = () if method == "slerp" else ("--inbetweener", tiny)
        assert run("infill", source, "-o", tmp_path / "out.bvh", *words, *words_of(method), *asked, "--quiet") == 0
        return (tmp_path / "out.bvh").read_text()

    return result


@pytest.fixture
def clip(tmp_path):
    """A file by rig and rate, 1.5 seconds long, in drawn Euler orders or with the channels that a motion needs."""

    def of(rig, fps=30, seed=None):
        path, motion = tmp_path / f"{rig}-{fps}-{seed}.bvh", on_rig(rig, round(1.5 * fps), fps=fps)
        if seed is None:
            motion.save(path)
            return path
        return with_all_channels(motion, path, seed=seed)

    return of


@pytest.mark.parametrize(("rig", "fps", "seed", "method"), [("bandai", 30, 1, "auto"), ("daz", 60, 3, "slerp")])
def test_frames_of_nan_are_gaps(infilled, clip, tmp_path, rig, fps, seed, method):
    source, gaps = clip(rig, fps, seed), ((fps // 3, fps // 2), (fps, fps + 7))
    lossy = without(source, tmp_path / "lossy.bvh", [("", *gap) for gap in gaps])
    words = [word for gap in gaps for word in ("--gap", "{}:{}".format(*gap))]
    assert infilled(lossy, method=method) == infilled(source, *words, method=method)


@pytest.mark.parametrize(("rig", "gap"), [("canonical", (20, 33)), ("bandai", None), ("daz", (20, 33))])
def test_joints_of_nan_are_lost_joints(infilled, clip, tmp_path, rig, gap):
    source = clip(rig, seed=4)
    start, stop = gap or (0, 45)
    lossy = without(source, tmp_path / "lossy.bvh", [(f"{name} ", start, stop) for name in NAMES[rig]])
    words = ["--joints", ",".join(NAMES[rig]), *(["--gap", f"{start}:{stop}"] if gap else [])]
    assert infilled(lossy) == infilled(source, *words)


def test_an_archive_with_nan_is_filled(infilled, tmp_path):
    on_rig("bandai", 45).save(tmp_path / "in.npz")
    frames = (slice(20, 30),)
    lossy = archive_without(
        tmp_path / "in.npz",
        tmp_path / "lossy.npz",
        local_quat_xyzw=frames,
        root_position_world=frames,
        moving_offsets=(slice(None), *frames),
    )
    assert infilled(lossy) == infilled(tmp_path / "in.npz", "--gap", "20:30")


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        ([("", 0, 45)], "every value is nan: nothing is known of the motion"),
        ([("Hips ", 0, 45)], "the gaps leave nothing of the motion's 45 frames to go by"),
        ([("", 0, 20), ("Hips Yposition", 20, 45)], "the gaps leave nothing of the motion's 45 frames to go by"),
    ],
)
def test_an_empty_selection_is_reported(tiny, clip, tmp_path, capsys, lost, said):
    lossy = without(clip("bandai"), tmp_path / "lossy.bvh", lost)
    assert run("infill", lossy, "-o", tmp_path / "out.bvh", "--inbetweener", tiny) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("mapctl: ")
    assert printed.err.count("\n") == 1
    assert said in printed.err
    assert not (tmp_path / "out.bvh").exists()


@pytest.mark.slow
@pytest.mark.parametrize("many", [False, True])
def test_denoising_believes_no_nan(clip, tmp_path, many):
    """As if a mask said so."""
    denoiser = save_tiny_denoiser(tmp_path / "denoiser.safetensors")
    source, folder = clip("bandai"), tmp_path / "folder"
    folder.mkdir()
    lossy = without(source, folder / "lossy.bvh", [("Hand_L", 20, 26)])
    (tmp_path / "mask.csv").write_text("joint,start,stop\nHand_L,20,26\n")
    words = ["--denoiser", denoiser, "--quiet"]
    assert run("denoise", source, "-o", tmp_path / "asked.bvh", "--mask", tmp_path / "mask.csv", *words) == 0
    given, out = (folder, tmp_path / "clean") if many else (lossy, tmp_path / "out.bvh")
    assert run("denoise", given, "-o", out, *words) == 0
    result = [mapctl.load(path) for path in (tmp_path / "asked.bvh", out / "lossy.bvh" if many else out)]
    assert (result[0].joint_positions() - result[1].joint_positions()).abs().max() < 1e-6


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return save_tiny_path(tmp_path_factory.mktemp("path") / "tiny.safetensors")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A walk of 60 frames on a rig with a root on the ground."""
    out = tmp_path_factory.mktemp("clip") / "walk.bvh"
    on_rig("bandai", 60).save(out)
    return out


def channels(file):
    rows = file.read_text().split("Frame Time")[1].splitlines()[1:]
    return np.array([row.split() for row in rows], dtype=float)


@pytest.mark.parametrize("finish", [[], ["--no-refine"]], ids=["map", "raw"])
def test_only_the_hips_place_changes_and_only_there(walked, path, tmp_path, finish):
    out = tmp_path / "out.bvh"
    words = ["--way", "10:20", "--way", "1s:1.5s", "--path", path, "--quiet", *finish]
    assert run("infill", walked, "-o", out, *words) == 0
    before, after = channels(walked), channels(out)
    changed = before != after
    assert set(np.flatnonzero(changed.any(axis=1))) <= {*range(10, 20), *range(30, 45)}
    assert changed[10:20].any(axis=1).sum() >= 8
    assert 1 <= changed.any(axis=0).sum() <= 3


def test_trajectories_and_gaps_go_together_and_are_printed(walked, path, tmp_path, capsys):
    infiller = save_tiny_infiller(tmp_path / "infiller.safetensors", drawn=0.2)
    report, out = tmp_path / "r.json", tmp_path / "out.bvh"
    words = ["--way", "10:40", "--gap", "20:25", "--path", path, "--method", "infiller", "--inbetweener", infiller]
    assert run("infill", walked, "-o", out, *words, "--report", report, "--no-refine") == 0
    assert "10:40" in capsys.readouterr().out
    (gap,) = json.loads(report.read_text())["gaps"]
    assert (gap["start"], gap["stop"], gap["root"]) == (10, 40, True)
    turned = (channels(walked) != channels(out)).sum(axis=1)
    assert turned[20:25].min() > 10
    assert turned[10:20].max() <= 3
