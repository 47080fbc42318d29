"""`--dna` of tween, infill and chain: motion files of any rig and classes by name, alone, mixed and drawn among."""

import json
from pathlib import Path

import pytest
import torch
from captures import on_rig
from helpers import run
from tiny_path import save_tiny_path
from tiny_prior import save_tiny_prior
from tiny_tweener import save_tiny_tweener

from mapctl import formats

FRAMES = 70


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Words for a tiny tweener that knows two classes."""
    folder = tmp_path_factory.mktemp("models")
    predictor = save_tiny_path(folder / "path.safetensors")
    trained = save_tiny_tweener(folder / "tweener.safetensors", str(predictor), ("walk", "wave-left-hand"))
    return ["--method", "tweener", "--inbetweener", trained, "--path", predictor, "--no-finish"]


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    return save_tiny_prior(tmp_path_factory.mktemp("prior") / "tiny.safetensors")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a clip to work on and one of another rig for its style."""
    monkeypatch.chdir(tmp_path)
    on_rig("bandai", FRAMES).save("in.bvh")
    on_rig("daz", 60).save("style.bvh")
    return tmp_path


JOBS = {
    "tween": ["in.bvh", "-o", "out.bvh", "--keyframes", "0,69"],
    "infill": ["in.bvh", "-o", "out.bvh", "--gap", "4:66"],
    "chain": ["in.bvh", "style.bvh", "-o", "out.bvh", "--gap", "60:61", "--piece", "20"],
}


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS)
def test_every_job_takes_files_and_classes(here, models, capsys, job):
    found = {}
    for dna in ("", "style.bvh", "walk", "style.bvh, walk"):
        words = ["--dna", dna] if dna else []
        assert run(job, *JOBS[job], *models, *words) == 0
        found[dna] = Path("out.bvh").read_bytes()
        told = capsys.readouterr().out
        named = dna.replace(", ", " and ")
        assert (f": tweener in the style of {named}" if dna else ": tweener") in told
    assert len(set(found.values())) == 4


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize(
    ("dna", "said"),
    [
        ("wavelefthand", "the nearest class is wave-left-hand"),
        ("no.bvh", "no.bvh: no such file"),
        ("style.bvh,,walk", "with a comma between two"),
        ("odd.bvh", "odd.bvh tells no style: the rig is not recognised"),
        ("none.bvh", "none.bvh, line "),
    ],
)
def test_what_is_no_style_is_said_and_nothing_is_written(here, models, capsys, job, dna, said):
    joint = "{\n OFFSET 0 1 0\n CHANNELS 3 Zrotation Xrotation Yrotation\n End Site\n {\n OFFSET 0 1 0\n }\n}\n"
    Path("odd.bvh").write_text(f"HIERARCHY\nROOT Thing\n{joint}MOTION\nFrames: 1\nFrame Time: 0.03\n0 0 0\n")
    head = Path("style.bvh").read_text().partition("Frames:")[0]
    Path("none.bvh").write_text(f"{head}Frames: 0\nFrame Time: 0.0333\n")
    before = set(here.iterdir())
    assert run(job, *JOBS[job], *models, "--dna", dna) == 2
    told = capsys.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert said in told.err
    assert set(here.iterdir()) == before


@pytest.mark.parametrize("job", JOBS)
@pytest.mark.parametrize("method", ["infiller", "transformer", "slerp", "rollouts"])
def test_methods_without_styles_refuse_them(here, capsys, job, method):
    assert run(job, *JOBS[job], "--method", method, "--dna", "style.bvh") == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"--method {method} knows no style" in told
    assert not Path("out.bvh").exists()


@pytest.mark.parametrize(
    ("job", "words", "said"),
    [
        ("infill", ["--curve", "line:2"], "--dna says how to move and --curve where"),
        ("tween", ["--best-of", "3"], "--best-of keeps one of several rollouts, which know no style"),
    ],
)
def test_options_that_do_not_go_with_a_style_are_refused(here, capsys, job, words, said):
    assert run(job, *JOBS[job], "--dna", "style.bvh", *words) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dna", "names"),
    [
        ("style.bvh", ["style.bvh", "style.bvh, 1 of its poses", "style.bvh, 1 of its poses"]),
        ("walk,style.bvh", ["walk and style.bvh", "walk|style.bvh", "walk|style.bvh"]),
        (None, ["", "walk|wave-left-hand", "walk|wave-left-hand"]),
    ],
)
def test_variations_are_drawn_among_styles_and_come_again(here, models, prior, capsys, dna, names):
    words = [*JOBS["tween"], *models, "--prior", prior, "--variations", 3, "--seed", 2, "--report", "r.json"]
    found = []
    for _ in range(2):
        assert run("tween", *words, *([] if dna is None else ["--dna", dna])) == 0
        found.append([Path(f"out_00{number}.bvh").read_bytes() for number in range(3)])
    assert found[0] == found[1]
    assert len(set(found[0])) == 3
    told = json.loads(Path("r.json").read_text())
    assert told["diversity"]["root_aligned_cm"] > 0
    assert all("energy_nats" in row for row in told["variations"])
    lines = capsys.readouterr().out.splitlines()[:3]
    for line, name in zip(lines, names, strict=True):
        style = line.partition(" in the style of ")[2]
        if "|" in name:
            assert style in name.split("|")
        else:
            assert style.startswith(name.partition(",")[0])
    if dna is not None and "," in dna:
        assert lines[1] != lines[2]


@pytest.mark.slow
def test_auto_takes_the_named_tweener_in_long_gaps_and_the_transformer_elsewhere(here, models, capsys):
    """Only a walk that lasts has a long gap; its path predictor may be named with it."""
    on_rig("bandai", 240).save("long.bvh")
    named = models[2:6]
    said = {}
    for method in ("auto", "tweener"):
        words = ["long.bvh", "-o", f"{method}.bvh", "--keyframes", "0,30,239", "--no-finish", "--method", method]
        assert run("tween", *words, *named) == 0
        said[method] = capsys.readouterr().out
    assert "frames 1:30: transformer" in said["auto"]
    assert "frames 31:239: tweener" in said["auto"]
    auto, alone = (formats.load(f"{method}.bvh") for method in ("auto", "tweener"))
    torch.testing.assert_close(auto.local_quat_xyzw[80:230], alone.local_quat_xyzw[80:230], atol=1e-4, rtol=0)
