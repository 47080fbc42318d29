"""`mapctl tween` as a user types it, its stitcher and styles in infill and chain too: keys, key files, reports."""

import json
import re
from pathlib import Path

import pytest
import torch
from captures import on_rig
from helpers import KEYS, run, walk
from methods import words_of
from tiny_infiller import save_tiny_infiller
from tiny_path import save_tiny_path
from tiny_prior import save_tiny_prior
from tiny_stitcher import save_tiny_stitcher
from tiny_tweener import save_tiny_tweener

import mapctl
from mapctl import formats, retarget

FRAMES = 45


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return save_tiny_infiller(tmp_path_factory.mktemp("infiller") / "tiny.safetensors", drawn=0.02)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A walk of 1.5 seconds on the Bandai rig."""
    path = tmp_path_factory.mktemp("source") / "in.bvh"
    on_rig("bandai", FRAMES).save(path)
    return path


@pytest.fixture
def tween(tiny):
    """Runs the command, with the tiny network where the method asks one; returns the exit status."""
    return lambda *words: run("tween", *words, *([] if "slerp" in words else ["--inbetweener", tiny]))


def away_cm(source, out, frames):
    """Measure the worst joint in these frames."""
    first, second = (mapctl.load(path).joint_positions()[list(frames)] for path in (source, out))
    return 100 * float((first - second).norm(dim=-1).max())


@pytest.mark.parametrize("method", ["auto", "infiller", "slerp"])
def test_keys_are_met_in_the_file(tween, source, tmp_path, method):
    out = tmp_path / "out.bvh"
    assert tween(source, "-o", out, "--keyframes", "0,17,30,44", *words_of(method), "--quiet") == 0
    assert mapctl.load(out).num_frames == FRAMES
    assert away_cm(source, out, (0, 17, 30, 44)) < 1e-4
    assert away_cm(source, out, range(FRAMES)) > 1


@pytest.mark.slow
def test_a_tweener_meets_keys_in_a_style_of_another_rig_s_clip(source, tmp_path):
    predictor = save_tiny_path(tmp_path / "path.safetensors")
    trained = save_tiny_tweener(tmp_path / "tweener.safetensors", str(predictor))
    on_rig("daz", 60).save(tmp_path / "style.bvh")
    result = []
    for name, words in (("plain", []), ("styled", ["--dna", tmp_path / "style.bvh"])):
        out = tmp_path / f"{name}.bvh"
        models = ["--inbetweener", trained, "--path", predictor]
        given = [source, "-o", out, "--keyframes", "0,44", "--method", "tweener", "--no-refine", "--quiet"]
        assert run("tween", *given, *models, *words) == 0
        assert away_cm(source, out, (0, 44)) < 1e-4
        result.append(out.read_bytes())
    assert result[0] != result[1]


@pytest.mark.slow
def test_frames_keys_and_notes_are_printed(tween, source, tmp_path, capsys):
    motion = on_rig("bandai", FRAMES)
    (hips,) = motion.moving_offsets
    motion.moving_offsets[hips][21:, 0] += 2.0
    motion.save(tmp_path / "leaping.bvh")
    words = ["--keyframes", "0,20,21,44", *words_of("infiller")]
    assert tween(tmp_path / "leaping.bvh", "-o", tmp_path / "out.bvh", *words) == 0
    printed = capsys.readouterr()
    first, note, gaps, licence = printed.out.splitlines()
    assert first.startswith(f"{tmp_path / 'out.bvh'}: 45 frames through 4 keys; ")
    assert note.startswith("the hips need ")
    assert note.endswith(" m/s between frames 20 and 21, faster than anyone runs")
    assert gaps == "frames 1:20, 22:44: infiller"
    assert licence.startswith("licence   none, it is made up (")
    assert printed.err == ""
    assert tween(tmp_path / "leaping.bvh", "-o", tmp_path / "out.bvh", *words, "--strict", "--quiet") == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "what"), [([], "pose"), (["--joints", "Hand_L, Foot_R"], "limbs"), (["--root-only"], "root")]
)
def test_a_report_lists_every_key_with_its_residual(tween, source, tmp_path, words, what):
    report = tmp_path / "r.json"
    words = [*words, "--keyframes", "0,16,33,44", *words_of("infiller"), "--report", report, "--quiet"]
    assert tween(source, "-o", tmp_path / "out.bvh", *words) == 0
    printed = json.loads(report.read_text())
    assert [(row["frame"], row["what"]) for row in printed["keys"]] == [
        (0, "pose"),
        (16, what),
        (33, what),
        (44, "pose"),
    ]
    assert all(row["missed_cm"] < 0.1 for row in printed["keys"])
    assert all(row.get("missed_deg", 0) < 1e-4 for row in printed["keys"])
    assert printed["request"]["command"] == "tween"
    assert (printed["request"]["keyframes"], printed["request"]["method"]) == ("0,16,33,44", "infiller")
    assert {"mapctl", "versions", "motion", "gaps", "ledger", "seconds", "frame_ms", "status"} <= set(printed)
    assert "skate_cm_s" in printed["measures"]


DOCS = Path(__file__).parents[2] / "docs" / "inputs"
GOOD = KEYS.replace("in.bvh", "walk.bvh") + "facing_deg = 30\n"


@pytest.fixture
def poses(tmp_path, monkeypatch):
    """Poses and keys beside them; the current poses is another."""
    (tmp_path / "keys").mkdir()
    (tmp_path / "here").mkdir()
    on_rig("bandai", 45).save(tmp_path / "keys" / "walk.bvh")
    on_rig("daz", 45).save(tmp_path / "keys" / "other.bvh")
    (tmp_path / "keys" / "keys.toml").write_text(GOOD)
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


@pytest.fixture
def models(tiny, prior):
    """By method, the options that name what it needs."""
    return {"auto": ["--inbetweener", tiny, "--prior", prior], "infiller": ["--inbetweener", tiny], "slerp": []}


@pytest.fixture
def tween_keys(models):
    """Runs the command; returns the exit status."""
    return lambda *words: run("tween", *words, *models["auto"])


def test_keys_of_every_kind_are_met_in_the_file(tween_keys, poses, capsys):
    words = [poses / "keys" / "keys.toml", "-o", "out.bvh", "--report", "r.json"]
    assert tween_keys(*words) == 0
    assert capsys.readouterr().out.startswith("out.bvh: 41 frames through 4 keys; ")
    result = mapctl.load("out.bvh")
    assert (result.num_frames, float(result.fps)) == (41, 30)
    assert result.skeleton.names == mapctl.load(poses / "keys" / "walk.bvh").skeleton.names
    assert result.root_position.isfinite().all()
    printed = json.loads(Path("r.json").read_text())
    assert [(row["frame"], row["what"]) for row in printed["keys"]] == [
        (0, "pose"),
        (15, "limbs"),
        (22, "root"),
        (40, "pose"),
    ]
    assert all(row["missed_cm"] < 0.1 for row in printed["keys"])
    canonical = retarget.to_canonical(result)[0]
    hand = canonical.joint_positions()[15, canonical.skeleton.index("leftHand")]
    assert hand.tolist() == pytest.approx([0.4, 1.2, 0.8], abs=2e-3)
    assert canonical.root_position[40, ::2].tolist() == pytest.approx([0.3, 1.5], abs=1e-4)
    assert "key_timing" not in printed


def test_timing_is_suggested_and_a_given_one_obeyed(poses, capsys):
    keys = poses / "keys" / "keys.toml"
    words = [*words_of("slerp"), "--suggest-timing", "--report", "r.json"]
    assert run("tween", keys, "-o", "out.bvh", *words) == 0
    assert mapctl.load("out.bvh").num_frames == 41
    (row,) = json.loads(Path("r.json").read_text())["key_timing"]
    assert (row["start"], row["stop"], row["given"]) == (0, 40, 40)
    assert row["usual"][0] <= row["suggested"] <= row["usual"][1]
    printed = capsys.readouterr().out
    assert re.search(rf"\b0 +40 +40 +{row['suggested']} +\w+", printed)
    assert "m/s" in printed


@pytest.mark.parametrize("method", ["slerp", *(pytest.param(m, marks=pytest.mark.slow) for m in ("auto", "bundled"))])
def test_the_example_runs_on_a_clip_of_its_name(models, tiny, poses, method):
    """The clip that it names is written by the command that it names; of the bundled densities the default ones
    roll."""
    text = (DOCS / "keys.toml").read_text()
    (named,) = set(re.findall(r'"([\w/]+\.bvh)"', text))
    clip = poses / "keys" / named
    clip.parent.mkdir(exist_ok=True)
    walk(120).save(clip)
    (poses / "keys" / "example.toml").write_text(text)
    words = (poses / "keys" / "example.toml", "-o", "out.bvh", "--report", "r.json", "--quiet")
    more = ["--inbetweener", tiny] if method == "bundled" else ["--method", method, *models[method]]
    assert run("tween", *words, *more) == 0
    printed = json.loads(Path("r.json").read_text())
    assert {row["what"] for row in printed["keys"]} == {"pose", "limbs", "root"}


PARTS = """
body = "walk.bvh"
[[key]]
frame = 0
root_only = "place"
place = [0, 0]
[[key]]
frame = 20
drawing = "pose.csv"
view_deg = 90
[[key]]
frame = 40
pose_frame = 40
half = "lower"
"""
DRAWING = "joint,x,y\nHips,3,98\nHead,4,160\nHand_L,30,130\nrightHand,0,80\nFoot_L,10,12\nFoot_R,-8,12\n"


@pytest.mark.parametrize("method", ["tweener", pytest.param("auto", marks=pytest.mark.slow)])
def test_keys_that_are_not_whole_are_met_in_the_file(models, poses, method):
    """The first of them has but a position."""
    (poses / "keys" / "keys.toml").write_text(PARTS)
    (poses / "keys" / "pose.csv").write_text(DRAWING)
    more = ["--method", "tweener", "--no-refine"] if method == "tweener" else models["auto"]
    words = [poses / "keys" / "keys.toml", "-o", "out.bvh", "--report", "r.json", "--quiet"]
    assert run("tween", *words, *more) == 0
    first, drawn, half = json.loads(Path("r.json").read_text())["keys"]
    assert [row["what"] for row in (first, drawn, half)] == ["place", "drawing", "half"]
    assert first["missed_cm"] < 0.1
    assert half["missed_cm"] < 0.1
    assert drawn["drawn_cm"] < 3
    result, walked = mapctl.load("out.bvh"), mapctl.load(poses / "keys" / "walk.bvh")
    canonical = [retarget.to_canonical(each)[0] for each in (result, walked)]
    assert canonical[0].root_position[0, ::2].tolist() == pytest.approx([0, 0], abs=1e-4)
    legs = [number for number, name in enumerate(canonical[0].skeleton.names) if "Leg" in name]
    turns = [each.local_quat_xyzw[40, legs] for each in canonical]
    assert (turns[0] * turns[1]).sum(dim=-1).abs().min() > 1 - 1e-6


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


def test_too_long_a_gap_falls_to_the_next_proposer_with_a_note(clip, capsys):
    words = ("tween", clip, "-o", "one.bvh", "--keyframes", "0,30", *STITCH)
    assert run(*(word for word in words if word != "--quiet")) == 0
    printed = capsys.readouterr().out
    assert "frames 1:30: transformer" in printed
    assert "longer than the 23 frames that the stitcher fills" in printed


@pytest.mark.slow
def test_auto_stitches_where_a_hand_is_keyed(clip, capsys):
    words = ("tween", clip, "-o", "one.bvh", "--no-refine", "--stitcher", "own.safetensors", "--joints", "leftHand")
    assert run(*words, "--keyframes", "0,10,20") == 0
    assert "frames 1:20: stitcher, led by the constraints in it" in capsys.readouterr().out
    assert run(*words, "--keyframes", "0,10,30") == 0
    printed = capsys.readouterr().out
    assert "frames 1:30: transformer" in printed
    assert "longer than the 23 frames that the stitcher fills" in printed


STYLED_FRAMES = 70


@pytest.fixture(scope="module")
def styled(tmp_path_factory):
    """Words for a tiny tweener that knows two classes."""
    folder = tmp_path_factory.mktemp("models")
    predictor = save_tiny_path(folder / "path.safetensors")
    trained = save_tiny_tweener(folder / "tweener.safetensors", str(predictor), ("walk", "wave-left-hand"))
    return ["--method", "tweener", "--inbetweener", trained, "--path", predictor, "--no-refine"]


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    return save_tiny_prior(tmp_path_factory.mktemp("prior") / "tiny.safetensors")


@pytest.fixture
def clips(tmp_path, monkeypatch):
    """A folder with a clip to work on and one of another rig for its style."""
    monkeypatch.chdir(tmp_path)
    on_rig("bandai", STYLED_FRAMES).save("in.bvh")
    on_rig("daz", 60).save("style.bvh")
    return tmp_path


JOBS = {
    "tween": ["in.bvh", "-o", "out.bvh", "--keyframes", "0,69"],
    "infill": ["in.bvh", "-o", "out.bvh", "--gap", "4:66"],
    "chain": ["in.bvh", "style.bvh", "-o", "out.bvh", "--gap", "60:61", "--piece", "20"],
}


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
def test_every_job_takes_files_and_classes(clips, styled, capsys, job):
    found = {}
    for dna in ("", "style.bvh", "walk", "style.bvh, walk"):
        words = ["--dna", dna] if dna else []
        assert run(job, *JOBS[job], *styled, *words) == 0
        found[dna] = Path("out.bvh").read_bytes()
        printed = capsys.readouterr().out
        named = dna.replace(", ", " and ")
        assert (f": tweener in the style of {named}" if dna else ": tweener") in printed
    assert len(set(found.values())) == 4
