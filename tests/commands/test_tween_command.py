"""`mapctl tween` as a user types it: keys in frames and seconds, reports, and what is refused."""

import json

import pytest
from captures import on_rig
from helpers import run
from methods import words_of
from tiny_infiller import save_tiny_infiller
from tiny_path import save_tiny_path
from tiny_tweener import save_tiny_tweener

import mapctl

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
def test_frames_keys_and_notes_are_told(tween, source, tmp_path, capsys):
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
def test_a_report_tells_every_key_and_how_far_it_is_missed(tween, source, tmp_path, words, what):
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
