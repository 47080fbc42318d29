"""The command line: every command does its job, in this process or in one of its own."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import run
from tiny_prior import save_tiny_prior

import mapctl
from mapctl.commands import generate as generate_run
from priors.lstm_gmm.density import PACE_LABELS


@pytest.fixture(scope="session")
def walk(prior, tmp_path_factory) -> Path:
    """Two seconds on a circle, with its report beside it."""
    path = tmp_path_factory.mktemp("walk") / "walk.bvh"
    report = str(path.with_suffix(".json"))
    assert run("follow", "circle:3", "-o", path, "--seconds", 2, "--prior", prior, "--report", report) == 0
    return path


def test_version_is_printed(capsys):
    assert run("--version") == 0
    assert capsys.readouterr().out == f"mapctl {mapctl.__version__}\n"


@pytest.mark.slow
def test_strict_fails_when_a_constraint_does(prior, tmp_path, capsys):
    """The made-up prior's data reach 2 m/s."""
    words = ("follow", "line:4", "-o", tmp_path / "a.bvh", "--seconds", 0.4, "--prior", prior)
    assert run(*words, "--speed", 6) == 0
    assert run(*words, "--speed", 6, "--strict") == 3
    out = capsys.readouterr().out
    assert "cannot all hold" in out
    assert "nan" not in out
    assert (tmp_path / "a.bvh").exists()
    scene = (
        f'prior = "{prior}"\noutputs = ["a.bvh"]\n[[actors]]\nname = "a"\ncurve = "line:4"\nseconds = 0.4\nspeed = 6\n'
    )
    (tmp_path / "fast.toml").write_text(scene)
    assert run("run", tmp_path / "fast.toml", "-o", tmp_path / "scene", "--quiet", "--strict") == 3


@pytest.mark.slow
def test_generate_writes_different_clips(prior, tmp_path):
    assert run("generate", "-o", tmp_path / "new" / "gen", "--seconds", 1.5, "--count", 3, "--prior", prior) == 0
    clips = sorted((tmp_path / "new" / "gen").iterdir())
    assert [clip.name for clip in clips] == [f"generated_00{k}.bvh" for k in range(3)]
    assert {mapctl.load(clip).num_frames for clip in clips} == {45}
    assert len({clip.read_bytes() for clip in clips}) == 3
    for name, words, same in (("one", (), True), ("planted", ("--no-footing",), False)):
        assert run("generate", "-o", tmp_path / name, "--seconds", 1.5, "--prior", prior, *words) == 0
        assert ((tmp_path / name / "generated_000.bvh").read_bytes() == clips[0].read_bytes()) is same


def test_convert_there_and_back(walk, tmp_path, capsys):
    assert run("convert", walk, tmp_path / "a.npz") == 0
    assert run("convert", tmp_path / "a.npz", tmp_path / "b.bvh") == 0
    assert (tmp_path / "b.bvh").read_text() == walk.read_text()
    assert "60 frames" in capsys.readouterr().out


@pytest.mark.parametrize(("fps", "frames"), [("60", 119), ("15", 30), ("30000/1001", 59)])
def test_convert_changes_the_frame_rate(walk, tmp_path, fps, frames):
    assert run("convert", walk, tmp_path / "a.bvh", "--fps", fps) == 0
    assert mapctl.load(tmp_path / "a.bvh").num_frames == frames


@pytest.mark.parametrize("rig", ["canonical", "clip"])
def test_convert_changes_the_rig(walk, tmp_path, rig):
    """From canonical to canonical nothing changes, whichever way the rig is named."""
    wanted = walk if rig == "clip" else rig
    assert run("convert", walk, tmp_path / "a.bvh", "--rig", wanted) == 0
    before, after = mapctl.load(walk), mapctl.load(tmp_path / "a.bvh")
    assert float((before.joint_positions() - after.joint_positions()).abs().max()) < 1e-5


def test_measure_prints_json_and_a_table(walk, capsys):
    words = ("measure", walk, "--curve", "circle:3", "--speed", 1.2, "--reference", walk)
    assert run(*words, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    report = json.loads(walk.with_suffix(".json").read_text())
    assert printed["measures"]["path_error_mean_cm"] == pytest.approx(
        report["measures"]["path_error_mean_cm"], abs=0.01
    )
    assert printed["reference"]["speed_m_s"] == printed["measures"]["speed_m_s"]
    assert {"mean", "p2", "p98"} == set(printed["mocap"]["sway_cm"])
    assert run(*words) == 0
    table = capsys.readouterr().out
    assert all(name in table for name in printed["measures"])


@pytest.mark.slow
def test_render_and_follow_make_films(walk, prior, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    assert run("render", walk, "-o", tmp_path / "a.png", "--size", "96x64", "--curve", "circle:3") == 0
    words = ("follow", "line:1", "--seconds", 0.2, "--prior", prior)
    assert run(*words, "-o", tmp_path / "b.bvh", "--video", tmp_path / "b.mp4") == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "b.mp4").read_bytes()[4:8] == b"ftyp"
    assert str(tmp_path / "b.mp4") in capsys.readouterr().out


def test_run_plays_a_scene(prior, tmp_path, monkeypatch):
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    scene = tmp_path / "scene.toml"
    scene.write_text(
        f'prior = "{prior}"\nsize = [96, 64]\noutputs = ["a.bvh", "a.png", "a.json"]\n'
        '[[actors]]\nname = "one"\ncurve = "line:2"\nseconds = 0.5\n'
        '[[actors]]\nname = "two"\ncurve = "circle:2"\nseconds = 0.7\nseed = 4\noffset = [1, 2]\n'
    )
    assert run("run", scene, "-o", tmp_path / "out") == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"a-one.bvh", "a-two.bvh", "a.png", "a.json"}
    report = json.loads((tmp_path / "out" / "a.json").read_text())
    assert report["actors"].keys() == {"one", "two"}
    assert report["actors"]["two"]["seed"] == 4
    assert report["actors"]["two"]["motion"]["frames"] == 21


def test_demo_leaves_four_files(prior, tmp_path, monkeypatch):
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    monkeypatch.setattr("mapctl.commands.demo.SCENE", str(tmp_path / "short.toml"))
    monkeypatch.setattr("mapctl.commands.demo.SIZE", (96, 64))
    (tmp_path / "short.toml").write_text('outputs = ["short.bvh"]\n[[actors]]\ncurve = "line:0.5"\n')
    assert run("demo", "-o", tmp_path / "demo", "--prior", prior, "--quiet") == 0
    written = {path.name for path in (tmp_path / "demo").iterdir()}
    assert written == {"figure8.bvh", "figure8.json", "figure8.mp4", "figure8.png"}


def test_info_names_what_is_here(prior, capsys):
    assert run("info") == 0
    printed = capsys.readouterr().out
    for word in (mapctl.__version__, "CC BY-NC 4.0", "rendering", "threads", "torch"):
        assert word in printed
    assert run("info", prior) == 0
    assert json.loads(capsys.readouterr().out)["kind"] == "lstm-gmm"


def presses_ctrl_c(monkeypatch, *, after):
    """Every walk from here on is interrupted once so many frames are solved."""
    from mapctl.problem.receding_horizon import RecedingHorizonSolver

    solve = RecedingHorizonSolver.solve

    def pressed(*words, progress, **options):
        def press(done, total):
            if done >= after:
                raise KeyboardInterrupt

        return solve(*words, progress=press, **options)

    monkeypatch.setattr(RecedingHorizonSolver, "solve", pressed)


@pytest.mark.slow
def test_an_interrupted_walk_is_written_as_far_as_it_was_solved(prior, tmp_path, monkeypatch, capsys):
    presses_ctrl_c(monkeypatch, after=20)
    files = {name: tmp_path / f"walk.{name}" for name in ("bvh", "json", "mp4")}
    words = ("-o", files["bvh"], "--report", files["json"], "--video", files["mp4"], "--prior", prior)
    assert run("follow", "circle:3", "--seconds", 4, *words) == 130
    printed = capsys.readouterr()
    assert "status    interrupted; what was solved until then is kept" in printed.out
    assert "walk.mp4" not in printed.out
    assert printed.err == "mapctl: interrupted; what was solved until then is written\n"
    assert {file.name for file in tmp_path.iterdir()} == {"walk.bvh", "walk.json"}
    assert mapctl.load(files["bvh"]).num_frames == 35
    report = json.loads(files["json"].read_text())
    assert (report["status"]["outcome"], report["motion"]["frames"]) == (
        "interrupted; what was solved until then is kept",
        35,
    )


def _started(words) -> subprocess.Popen[str]:
    """mapctl in a process that heeds Ctrl-C, also where the tests run in the background and ignore it."""
    return subprocess.Popen(
        [sys.executable, "-m", "mapctl.cli", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def _ended(process: subprocess.Popen[str]) -> tuple[str, str]:
    """Return the last output of a process; it is killed if it does not end."""
    try:
        return process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        raise


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (signal.SIGINT, (130, "mapctl: interrupted\n")),
        pytest.param(signal.SIGTERM, (143, "mapctl: terminated\n"), marks=pytest.mark.slow),
    ],
)
def test_interruption_leaves_nothing_half_done(prior, tmp_path, number, said):
    """Ctrl-C or SIGTERM in the middle of hours of motion: no traceback, no file, no folder."""
    words = ("generate", "-o", tmp_path / "gen", "--seconds", 36_000, "--prior", prior)
    process = _started(words)
    while not (tmp_path / "gen").exists() and process.poll() is None:
        time.sleep(0.1)
    time.sleep(0.5)  # by then it samples
    process.send_signal(number)
    process.send_signal(number)  # `timeout` sends it twice
    _, printed = _ended(process)
    assert (process.returncode, printed) == said
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_waits_for_the_compiler():
    """LLVM calls back while numba compiles: an exception there is lost, and what the callback did not do crashes."""
    script = """
import ctypes, signal, sys, time
from llvmlite.binding import executionengine
from numba import njit
from mapctl import cli

def interrupt(*given):
    signal.raise_signal(signal.SIGINT)
    return ctypes.string_at(*given)

class Compiling:
    def run(self):
        njit(lambda x: x + 1)(1)
        time.sleep(10)

executionengine.string_at = interrupt  # of the callback that gets the compiled code
cli.parse = lambda words: Compiling()
sys.exit(cli.main())
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (130, "mapctl: interrupted\n")


@pytest.mark.slow
def test_a_walk_interrupted_from_outside_leaves_a_whole_file_or_none(prior, tmp_path):
    words = ("follow", "circle:4", "-o", tmp_path / "walk.bvh", "--seconds", 3000, "--prior", prior)
    process = _started(words)
    time.sleep(5)
    process.send_signal(signal.SIGTERM)
    _, printed = _ended(process)
    assert process.returncode == 143
    assert "Traceback" not in printed
    assert printed.startswith("mapctl: terminated")
    written = (tmp_path / "walk.bvh").exists()
    assert written == ("what was solved until then is written" in printed)
    assert not written or 2 < mapctl.load(tmp_path / "walk.bvh").num_frames < 90_000


@pytest.mark.slow
def test_a_closed_pipe_is_no_error():
    """As in `mapctl measure walk.bvh | head -1`."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "mapctl.cli", "--version"], stdout=writer, stderr=subprocess.PIPE, timeout=120
    )
    os.close(writer)
    assert b"Traceback" not in done.stderr
    assert done.returncode == 1


def test_a_full_disk_for_what_is_printed_is_one_line():
    with Path("/dev/full").open("wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "mapctl.cli", "--version"], stdout=full, stderr=subprocess.PIPE, timeout=120
        )
    assert (done.returncode, done.stderr) == (2, b"mapctl: input or output: No space left on device\n")


@pytest.fixture(scope="module")
def paced_prior(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paces")
    return save_tiny_prior(folder / "prior.safetensors", labels=("style=elderly", *PACE_LABELS))


@pytest.mark.parametrize(
    ("style", "paced", "like_start"),
    [
        (None, True, True),
        ("elderly", True, False),
        ("walk", False, False),
        ("elderly,pace=run", False, False),
        ("none", False, False),
    ],
)
def test_paces_are_inferred_unless_one_is_named(tmp_path, paced_prior, monkeypatch, style, paced, like_start):
    class Asked(Exception):
        """Generation has begun."""

    def stream(*_given, settings, **_more):
        raise Asked(settings.vary_paces, settings.condition_on_start)

    monkeypatch.setattr(generate_run, "stream", stream)
    words = () if style is None else ("--style", style)
    with pytest.raises(Asked) as asked:
        run("generate", "-o", tmp_path / "out", "--seconds", 1, "--prior", paced_prior, *words)
    assert asked.value.args == (paced, like_start)
