"""`mapctl denoise` as a user types it: files, folders, reports, and what is refused."""

import json
from importlib.util import find_spec
from pathlib import Path

import pytest
from captures import error_cm, noisy, on_rig
from helpers import run, walk
from tiny_denoiser import save_tiny_denoiser
from tiny_prior import save_tiny_prior

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
    told = capsys.readouterr()
    on_rig("bandai", 40).save(tmp_path / "truth.bvh")
    before, after, truth = map(mapctl.load, (recording, out, tmp_path / "truth.bvh"))
    assert after.skeleton.matches(before.skeleton)
    assert (after.num_frames, after.fps) == (before.num_frames, before.fps)
    assert error_cm(truth, after) < 0.9 * error_cm(truth, before)
    assert f"{out}: 40 frames at 30 a second" in told.out
    assert "noise: " in told.out
    assert "and 15 more joints" in told.out
    assert told.err == ""


def test_report_and_mask(denoise, recording, tmp_path):
    (tmp_path / "m.csv").write_text("joint,start,stop\nHand_L,10,14\n*,30,31\n")
    report = tmp_path / "r.json"
    words = ["--mask", tmp_path / "m.csv", "--report", report, "--quiet"]
    assert denoise(recording, "-o", tmp_path / "out.bvh", *words) == 0
    told = json.loads(report.read_text())
    assert told["request"]["command"] == "denoise"
    assert {"faults", "correction_cm", "contacts", "ledger", "fallback", "measures", "versions", "status"} <= set(told)
    lost = {(f["joint"], f["start"], f["stop"]) for f in told["faults"] if f["kind"] == "dropout"}
    assert {("Hand_L", 10, 14), ("Hand_L", 30, 31), ("Hips", 30, 31)} <= lost


@pytest.mark.slow
def test_causal_is_said(denoise, recording, tmp_path, capsys):
    assert denoise(recording, "-o", tmp_path / "out.bvh", "--causal", "--delay", 0.3) == 0
    assert "causal: a frame is decided at most 0.30 s after it came" in capsys.readouterr().out
    assert mapctl.load(tmp_path / "out.bvh").num_frames == 40


@pytest.fixture
def folder(tmp_path):
    """Two captures of which one lies deeper, and a file that is none."""
    place = tmp_path / "in"
    (place / "deep").mkdir(parents=True)
    noisy(on_rig("bandai", 20)).save(place / "a.bvh")
    noisy(on_rig("daz", 20)).save(place / "deep" / "b.bvh")
    (place / "deep" / "notes.txt").write_text("no motion")
    return place


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
    assert "1 denoised" in (told := capsys.readouterr().out)
    assert "1 there already, 0 failed" in told
    assert (out / "deep" / "b.bvh").read_text() == "done before"
    assert denoise(folder, "-o", out, "--again", "--quiet") == 0
    assert mapctl.load(out / "deep" / "b.bvh").num_frames == 20


@pytest.mark.slow
def test_failures_are_listed_and_stop_no_other_file(denoise, folder, tmp_path, capsys):
    (folder / "0-broken.bvh").write_text("HIERARCHY\nnonsense")
    walk(20).save(folder / "c.npz")
    assert denoise(folder, "-o", tmp_path / "out") == 3
    told = capsys.readouterr().out
    assert "3 denoised, " in told
    assert "1 failed" in told
    assert told.count("failed: ") == 1
    assert "0-broken.bvh" in told
    assert (tmp_path / "out" / "a.bvh").exists()
    assert (tmp_path / "out" / "c.npz").exists()
    assert not (tmp_path / "out" / "0-broken.bvh").exists()


@pytest.mark.slow
def test_an_interrupted_folder_says_what_is_done_and_goes_on(denoise, folder, tmp_path, monkeypatch, capsys):
    save, out = formats.save, tmp_path / "out"

    def interrupted(motion, path):
        if path.name != "a.bvh":
            raise KeyboardInterrupt
        save(motion, path)

    with monkeypatch.context() as patch:
        patch.setattr(formats, "save", interrupted)
        assert denoise(folder, "-o", out) == 130
    told = capsys.readouterr().err
    assert told == "mapctl: interrupted; 1 of 2 files are finished; the same command goes on with the others\n"
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


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["in.bvh", "-o", "a.bvh", "--mask", "gone.csv"], "gone.csv"),
        (["in.bvh", "-o", "a.bvh", "--mask", "wrong.csv"], "line 2"),
        (["in.bvh", "-o", "a.bvh", "--mask", "name.csv"], "no joint 'Hnad_L' to mask; the nearest is Hand_L"),
        (["in.bvh", "-o", "a.bvh", "--mask", "late.csv"], "ends at 50, the recording at 40"),
        (["in.bvh", "-o", "a.bvh", "--causal", "--delay", "0"], "the delay must be"),
        (["in.bvh", "-o", "a.bvh", "--causal", "--prior", "locomotion"], "leave --prior out"),
        (["in.bvh", "-o", "a.bvh", "--cluster", "local"], "--cluster is for folders; in.bvh is a file"),
        (["in.bvh", "-o", "a.bvh", "--again"], "--again is for folders"),
        (["in.bvh", "-o", "a.bvh", "--jobs", "2"], "--jobs is for folders"),
        (["in.bvh", "-o", "a.bvh", "--delay", "0.2"], "--delay is how far --causal may look ahead"),
        (["folder", "-o", "out", "--delay", "0.2"], "--delay is how far --causal may look ahead"),
        (["folder", "-o", "out", "--strict"], "--strict is for single files"),
        (["folder", "-o", "out", "--cluster", "10.0.0.1:6379", "--jobs", "2"], "--jobs is for this machine"),
        (["folder", "-o", "out", "--mask", "wrong.csv"], "--mask is for single files; folder is a folder"),
        (["folder", "-o", "out", "--video", "p.mp4"], "--video is for single files"),
        (["folder", "-o", "out", "--causal"], "--causal is for single files"),
        (["folder", "-o", "out", "--prior", "locomotion"], "--prior is for single files"),
        (["folder", "-o", "out", "--jobs", "0"], "--jobs must be at least 1, got 0"),
        (["folder", "-o", "in.bvh"], "in.bvh"),
        (["empty", "-o", "out"], "below empty"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_is_wrong_is_said_in_a_line_and_nothing_is_written(fails, tiny, recording, words, said):
    Path("in.bvh").write_bytes(recording.read_bytes())
    Path("wrong.csv").write_text("joint,start,stop\nHand_L,4,x\n")
    Path("name.csv").write_text("joint,start,stop\nHnad_L,4,6\n")
    Path("late.csv").write_text("joint,start,stop\nHand_L,4,50\n")
    for name in ("folder/a.bvh", "empty/a.txt"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_bytes(recording.read_bytes())
    assert said in fails("denoise", *words, "--denoiser", tiny)


def test_a_folder_is_refused_with_a_network_that_is_no_denoiser(folder, tmp_path, capsys):
    prior = save_tiny_prior(tmp_path / "prior.safetensors")
    for name, said in ((prior, "a lstm-gmm is no denoiser"), ("nobody", "no prior 'nobody'")):
        assert run("denoise", folder, "-o", tmp_path / "out", "--denoiser", name) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
