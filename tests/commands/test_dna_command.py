"""`--dna` of tween, infill and chain: motion files of any rig and classes by name, alone, mixed and drawn among."""

from pathlib import Path

import pytest
from captures import on_rig
from helpers import run
from tiny_path import save_tiny_path
from tiny_prior import save_tiny_prior
from tiny_tweener import save_tiny_tweener

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
    ("job", "words", "said"), [("infill", ["--curve", "line:2"], "--dna says how to move and --curve where")]
)
def test_options_that_do_not_go_with_a_style_are_refused(here, capsys, job, words, said):
    assert run(job, *JOBS[job], "--dna", "style.bvh", *words) == 2
    assert said in capsys.readouterr().err
