"""Commands with the free weights alone, as a user types them, and which set of weights is taken."""

import json
import shutil

import pytest
from helpers import run, walk
from tiny_weights import FREE, save_tiny_weights

import mapctl
from priors import weight_sets

NOT_FREE = "CC BY-NC 4.0"
SCENE = 'outputs = ["a.npz", "a.json"]\n[[actors]]\ncurve = "line:0.5"\n'
KEYS = 'body = "in.bvh"\n[[key]]\nframe = 0\npose = "in.bvh"\n[[key]]\nframe = 12\npose = "in.bvh"\npose_frame = 12\n'


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder of both sets."""
    folder = tmp_path_factory.mktemp("weights")
    save_tiny_weights(folder, NOT_FREE)
    save_tiny_weights(folder / "free")
    return folder


@pytest.fixture
def work(tmp_path, monkeypatch):
    """The current folder, with what commands read."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAPCTL_RENDERER", "stick")
    monkeypatch.delenv(weight_sets.VARIABLE, raising=False)
    walk(40).save(tmp_path / "in.bvh")
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "keys.toml").write_text(KEYS)
    return tmp_path


@pytest.fixture
def both(saved, work, monkeypatch):
    """Both sets, in a folder of their own."""
    shutil.copytree(saved, work / "weights")
    monkeypatch.setenv(weight_sets.FOLDER_VARIABLE, str(work / "weights"))
    return work


def licence_of(report):
    return json.loads(report.read_text())["licence"]


def test_what_the_free_set_lacks_is_refused_in_one_line(both, fails):
    for name in ("transformer", "general", "tweener"):
        for ending in ("json", "safetensors"):
            (both / "weights" / "free" / f"{name}.{ending}").unlink()
    for words in (("infill", "in.bvh", "-o", "o.bvh", "--gap", "10:20"), ("denoise", "in.bvh", "-o", "o.bvh")):
        assert "the free weights have no 'transformer': they hold denoiser, " in fails(*words, "--weights", "free")
    words = ("infill", "in.bvh", "-o", "o.bvh", "--gap", "10:20", "--method", "tweener", "--weights", "free")
    assert "the free weights have no 'tweener': they hold denoiser, " in fails(*words)
    assert "no 'general'" in fails("follow", "line:1", "-o", "o.bvh", "--weights", "free", "--prior", "general")


def test_the_option_comes_before_the_scene_file_and_that_before_the_environment(both, monkeypatch):
    def used(*words):
        assert run("run", "scene.toml", "--quiet", *words) == 0
        return set(licence_of(both / "a.json")["models"])

    assert used() == {"locomotion"}
    monkeypatch.setenv(weight_sets.VARIABLE, "free")
    assert used() == {"free/locomotion"}
    (both / "scene.toml").write_text(f'weights = "full"\n{SCENE}')
    assert used() == {"locomotion"}
    assert used("--weights", "free") == {"free/locomotion"}
    monkeypatch.delenv(weight_sets.VARIABLE)
    (both / "scene.toml").write_text(f'weights = "free"\n{SCENE}')
    assert used() == {"free/locomotion"}
    assert used("--weights", "full") == {"locomotion"}


def test_weights_that_do_not_exist_are_refused_in_one_line(both, fails, monkeypatch):
    words = ("follow", "line:1", "-o", "out.bvh")
    assert "must be free or full, got 'libre'" in fails(*words, "--weights", "libre")
    (both / "scene.toml").write_text(f'weights = "libre"\n{SCENE}')
    printed = fails("run", "scene.toml")
    assert "scene.toml" in printed
    assert "weights" in printed
    (both / "keys.toml").write_text(f'weights = "libre"\n{KEYS}')
    assert "weights" in fails("tween", "keys.toml", "-o", "out.bvh")
    (both / "shot.toml").write_text('weights = "libre"\n[[key]]\nseconds = 0.5\nlook_at = [0.0, 1.5, 3.0]\n')
    assert "weights" in fails(*words, "--keys", "shot.toml")
    monkeypatch.setenv(weight_sets.VARIABLE, "libre")
    assert "MAPCTL_WEIGHTS must be free or full, got 'libre'" in fails(*words)


def test_the_strictest_of_all_models_is_the_licence(both, capsys):
    assert run("denoise", "in.bvh", "-o", "out.glb", "--denoiser", "free/denoiser", "--report", "out.json") == 0
    assert f"licence   {NOT_FREE} (transformer); {FREE} (free/denoiser)" in capsys.readouterr().out
    printed = licence_of(both / "out.json")
    assert printed == {"strictest": NOT_FREE, "models": {"free/denoiser": FREE, "transformer": NOT_FREE}}


@pytest.mark.parametrize("ending", ["npz", "glb"])
def test_a_motion_keeps_its_licence_from_file_to_file(both, capsys, ending):
    assert run("follow", "line:1", "-o", f"walk.{ending}", "--quiet") == 0
    assert run("info", f"walk.{ending}", "--json") == 0
    assert json.loads(capsys.readouterr().out)["licence"] == f"{NOT_FREE} (locomotion)"
    assert run("denoise", f"walk.{ending}", "-o", "clean.npz", "--weights", "free") == 0
    line = f"{NOT_FREE} (walk.{ending}); {FREE} (free/denoiser, free/transformer)"
    assert f"licence   {line}" in capsys.readouterr().out
    assert mapctl.load("clean.npz").licence == line
    assert run("convert", "clean.npz", "copy.glb") == 0
    assert mapctl.load("copy.glb").licence == line


def test_info_lists_both_sets(both, capsys):
    assert run("info", "--json", "--weights", "free") == 0
    printed = json.loads(capsys.readouterr().out)
    names = [row["name"] for row in printed["priors"]]
    assert "locomotion" in names
    assert "free/locomotion" in names
    assert printed["weights"]["in_force"] == "free"
    assert printed["weights"]["free"]["licence"] == FREE
    assert printed["weights"]["full"]["licence"] == NOT_FREE
    assert printed["weights"]["free"]["models"] == [name for name in names if name.startswith("free/")]
    assert run("info") == 0
    table = capsys.readouterr().out
    assert "free/locomotion" in table
    assert "full (in force)" in table
    assert run("info", "locomotion", "--weights", "free") == 0
    assert json.loads(capsys.readouterr().out)["licence"] == FREE
