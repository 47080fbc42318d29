"""`mapctl denoise` as a user types it: files, folders, reports, and what is refused."""

import json
from importlib.util import find_spec

import pytest
from captures import error_cm, noisy, on_rig
from helpers import run, walk
from tiny_denoiser import save_tiny_denoiser

import mapctl
from mapctl import formats


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return save_tiny_denoiser(tmp_path_factory.mktemp("denoiser") / "tiny.safetensors")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A noisy capture in a file."""
    path = tmp_path_factory.mktemp("capture") / "in.bvh"
    noisy(on_rig("bandai", 40)).save(path)
    return path


@pytest.fixture
def denoise(tiny):
    """Runs the command; returns the exit status."""
    return lambda *words: run("denoise", *words, "--denoiser", tiny)


def test_a_file_comes_back_clean(denoise, recording, tmp_path, capsys):
    out = tmp_path / "out.bvh"
    assert denoise(recording, "-o", out) == 0
    printed = capsys.readouterr()
    on_rig("bandai", 40).save(tmp_path / "truth.bvh")
    before, after, truth = map(mapctl.load, (recording, out, tmp_path / "truth.bvh"))
    assert after.skeleton.matches(before.skeleton)
    assert (after.num_frames, after.fps) == (before.num_frames, before.fps)
    assert error_cm(truth, after) < 0.9 * error_cm(truth, before)
    assert f"{out}: 40 frames at 30 a second" in printed.out
    assert "noise: " in printed.out
    assert "and 15 more joints" in printed.out
    assert printed.err == ""


def test_report_and_mask(denoise, recording, tmp_path):
    (tmp_path / "m.csv").write_text("joint,start,stop\nHand_L,10,14\n*,30,31\n")
    report = tmp_path / "r.json"
    words = ["--mask", tmp_path / "m.csv", "--report", report, "--quiet"]
    assert denoise(recording, "-o", tmp_path / "out.bvh", *words) == 0
    printed = json.loads(report.read_text())
    assert printed["request"]["command"] == "denoise"
    assert {"faults", "correction_cm", "contacts", "ledger", "fallback", "measures", "versions", "status"} <= set(
        printed
    )
    lost = {(f["joint"], f["start"], f["stop"]) for f in printed["faults"] if f["kind"] == "dropout"}
    assert {("Hand_L", 10, 14), ("Hand_L", 30, 31), ("Hips", 30, 31)} <= lost


@pytest.mark.slow
def test_causal_is_reported(denoise, recording, tmp_path, capsys):
    assert denoise(recording, "-o", tmp_path / "out.bvh", "--causal", "--delay", 0.3) == 0
    assert "causal: a frame is decided at most 0.30 s after it came" in capsys.readouterr().out
    assert mapctl.load(tmp_path / "out.bvh").num_frames == 40


@pytest.fixture
def folder(tmp_path):
    """Two captures of which one lies deeper, and a file that is none."""
    position = tmp_path / "in"
    (position / "deep").mkdir(parents=True)
    noisy(on_rig("bandai", 20)).save(position / "a.bvh")
    noisy(on_rig("daz", 20)).save(position / "deep" / "b.bvh")
    (position / "deep" / "notes.txt").write_text("no motion")
    return position


@pytest.mark.slow
def test_a_folder_becomes_a_folder_of_the_same_names(denoise, folder, tmp_path, capsys):
    out, reports = tmp_path / "out", tmp_path / "reports"
    assert denoise(folder, "-o", out, "--report", reports) == 0
    assert sorted(str(f.relative_to(out)) for f in out.rglob("*.*")) == ["a.bvh", "deep/b.bvh"]
    assert sorted(str(f.relative_to(reports)) for f in reports.rglob("*.*")) == ["a.json", "deep/b.json"]
    assert json.loads((reports / "a.json").read_text())["motion"]["frames"] == 20
    assert "2 denoised" in capsys.readouterr().out


@pytest.mark.slow
def test_what_is_there_is_not_done_again_unless_asked_for(denoise, folder, tmp_path, capsys):
    out = tmp_path / "out"
    (out / "deep").mkdir(parents=True)
    (out / "deep" / "b.bvh").write_text("done before")
    assert denoise(folder, "-o", out) == 0
    assert "1 denoised" in (printed := capsys.readouterr().out)
    assert "1 there already, 0 failed" in printed
    assert (out / "deep" / "b.bvh").read_text() == "done before"
    assert denoise(folder, "-o", out, "--again", "--quiet") == 0
    assert mapctl.load(out / "deep" / "b.bvh").num_frames == 20


@pytest.mark.slow
def test_failures_are_listed_and_stop_no_other_file(denoise, folder, tmp_path, capsys):
    (folder / "0-broken.bvh").write_text("HIERARCHY\nnonsense")
    walk(20).save(folder / "c.npz")
    assert denoise(folder, "-o", tmp_path / "out") == 3
    printed = capsys.readouterr().out
    assert "3 denoised, " in printed
    assert "1 failed" in printed
    assert printed.count("failed: ") == 1
    assert "0-broken.bvh" in printed
    assert (tmp_path / "out" / "a.bvh").exists()
    assert (tmp_path / "out" / "c.npz").exists()
    assert not (tmp_path / "out" / "0-broken.bvh").exists()


@pytest.mark.slow
def test_an_interrupted_folder_lists_finished_files_and_resumes(denoise, folder, tmp_path, monkeypatch, capsys):
    save, out = formats.save, tmp_path / "out"

    def interrupted(motion, path):
        if path.name != "a.bvh":
            raise KeyboardInterrupt
        save(motion, path)

    with monkeypatch.context() as patch:
        patch.setattr(formats, "save", interrupted)
        assert denoise(folder, "-o", out) == 130
    printed = capsys.readouterr().err
    assert printed == "mapctl: interrupted; 1 of 2 files are finished; the same command goes on with the others\n"
    assert denoise(folder, "-o", out) == 0
    assert ", 1 there already" in capsys.readouterr().out


@pytest.mark.slow
def test_more_processes_give_the_same_files(denoise, folder, tmp_path):
    assert denoise(folder, "-o", tmp_path / "one", "--quiet") == 0
    assert denoise(folder, "-o", tmp_path / "two", "--jobs", 2, "--quiet") == 0
    for name in ("a.bvh", "deep/b.bvh"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_a_cluster_of_this_machine_gives_the_same_files(denoise, folder, tmp_path):
    assert denoise(folder, "-o", tmp_path / "one", "--quiet") == 0
    assert denoise(folder, "-o", tmp_path / "two", "--cluster", "local", "--jobs", 2, "--quiet") == 0
    for name in ("a.bvh", "deep/b.bvh"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
