"""Contract of every command that writes a motion: it runs on tiny weights, writes what it names, says its licence, and
gives the same bytes twice.
"""

import json
import os
import shutil
from pathlib import Path

import pytest
from helpers import run, walk
from tiny_weights import FREE, save_tiny_weights

import mapctl
from mapctl.commands import bench
from priors import weight_sets

BUNDLED = weight_sets.list_models("free")  # so that tests see what a user sees without the others
SCENE = 'outputs = ["a.npz", "a.json"]\n[[actors]]\ncurve = "line:0.5"\n'

JOBS = {
    "follow": ("follow line:1 -o out.npz --report out.json", {"locomotion"}),
    "follow a shot": ("follow line:1 -o out.npz --end stand --report out.json", {"locomotion", "transformer"}),
    "run": ("run scene.toml", {"locomotion"}),
    "generate": ("generate -o made --seconds 0.5 --no-footing --to .npz", {"locomotion"}),
    "steer": ("steer c.csv -o out.npz --report out.json", {"locomotion"}),
    "denoise": ("denoise in.bvh -o out.npz --report out.json", {"denoiser", "transformer"}),
    "denoise with densities": (
        "denoise in.bvh -o out.npz --prior auto --report out.json",
        {"denoiser", "general", "locomotion", "transformer"},
    ),
    "denoise a folder": ("denoise clips -o clean --jobs 2 --report reports --again", {"denoiser", "transformer"}),
    "infill": ("infill in.bvh -o out.npz --gap 10:20 --report out.json", {"transformer"}),
    "infill a long gap": ("infill long.bvh -o out.npz --gap 10:200 --no-refine --report out.json", {"transformer"}),
    "infill by a stitcher": ("infill in.bvh -o out.npz --gap 10:20 --method stitcher --report out.json", {"stitcher"}),
    "infill by rollouts": (
        "infill in.bvh -o out.npz --gap 10:14 --method rollouts --report out.json",
        {"general", "locomotion"},
    ),
    "tween": (
        "tween in.bvh -o out.npz --keyframes 0,12 --suggest-timing --report out.json",
        {"keyframe-timing", "transformer"},
    ),
    "blend": (
        "blend in.bvh --from other.bvh --joints leftHand --frames 5:10 --at 15 -o out.npz --no-refine",
        {"transformer"},
    ),
    "chain": ("chain in.bvh other.bvh -o out.npz --piece 10 --gap 9:10 --no-refine", {"transformer"}),
}
"""Words by what they do, and the models that they need at least."""
QUICK = {"follow", "run", "steer", "denoise", "chain"}
CASES = [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in JOBS]
MOTIONS = ("out.npz", "a.npz", "made/generated_000.npz", "clean/one.bvh")
REPORTS = ("out.json", "a.json", "reports/one.json")


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The free set alone."""
    folder = tmp_path_factory.mktemp("weights")
    save_tiny_weights(folder / "free", models=BUNDLED)
    return folder


@pytest.fixture
def here(saved, tmp_path, monkeypatch):
    """The current folder, with what commands read."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    monkeypatch.setenv(weight_sets.FOLDER_VARIABLE, str(saved))
    monkeypatch.delenv(weight_sets.VARIABLE, raising=False)
    walk(40).save(tmp_path / "in.bvh")
    walk(40, turn_rate=0.3, seed=1).save(tmp_path / "other.bvh")
    walk(210).save(tmp_path / "long.bvh")
    (tmp_path / "clips").mkdir()
    shutil.copy(tmp_path / "in.bvh", tmp_path / "clips" / "one.bvh")
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "c.csv").write_text("time_s,speed_mps,heading_deg\n0,1.0,0\n0.5,1.0,0\n")
    return tmp_path


def written(folder: Path, names: tuple[str, ...]) -> list[Path]:
    return [folder / name for name in names if (folder / name).exists()]


@pytest.mark.parametrize("name", CASES)
def test_a_command_writes_what_it_names_under_its_licence_and_twice_the_same(here, capsys, name):
    words, needed = JOBS[name]
    assert run(*words.split(), "--weights", "free") == 0
    printed = capsys.readouterr().out.splitlines()
    (line,) = [line for line in printed if line.startswith("licence   ")]
    assert line.startswith(f"licence   {FREE} (free/")
    assert all(f"free/{model}" in line for model in needed)
    (motion,) = written(here, MOTIONS)
    assert motion.suffix != ".npz" or mapctl.load(motion).licence.startswith(f"{FREE} (free/")
    assert "/tmp" not in mapctl.load(motion).licence
    assert [(here / word).exists() for word in words.split() if word.endswith(".json")] in ([], [True])
    for report in written(here, REPORTS):
        found = json.loads(report.read_text())
        assert found["licence"]["strictest"] == FREE
        assert {f"free/{model}" for model in needed} <= set(found["licence"]["models"])
        assert found["request"]["command"] == words.split()[0]
        for one in found.get("actors", {"": found}).values():
            assert {"mapctl", "request", "versions", "status", "motion", "ledger", "measures", "timing"} <= set(one)
    assert weight_sets.VARIABLE not in os.environ
    first = motion.read_bytes()
    assert run(*words.split(), "--weights", "free", "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert motion.read_bytes() == first


@pytest.mark.slow
@pytest.mark.parametrize("name", ["follow", "denoise", "infill", "tween", "blend", "chain"])
def test_a_film_is_written_beside_the_motion(here, name):
    pytest.importorskip("PIL")
    assert run(*JOBS[name][0].split(), "--weights", "free", "--quiet", "--video", "v.png") == 0
    assert (here / "v.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_bench_measures_cost(prior, monkeypatch, capsys):
    monkeypatch.setattr(bench, "SECONDS", (1.0,))
    assert run("bench", "--prior", prior, "--live", prior, "--json") == 0
    follow, steer = json.loads(capsys.readouterr().out)["rows"]
    assert min(follow["ms_per_frame"], steer["ms_per_frame"]) > 0
