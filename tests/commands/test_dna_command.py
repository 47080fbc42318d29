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
    return ["--method", "tweener", "--inbetweener", trained, "--path", predictor, "--no-refine"]


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
        printed = capsys.readouterr().out
        named = dna.replace(", ", " and ")
        assert (f": tweener in the style of {named}" if dna else ": tweener") in printed
    assert len(set(found.values())) == 4
