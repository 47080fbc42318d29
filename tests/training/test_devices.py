"""Training on a GPU: every model, on a device that is pretended, comes to what it comes to on the processor."""

import json
from dataclasses import replace

import pytest
import torch
from ended_models import MODELS, VARIANTS, list_params
from helpers import run as mapctl_run
from pretended_device import NAME, pretend_device, replace_gpu
from safetensors.torch import load_file, save_file

from mapctl.errors import RequestError
from priors.training import recipe, run, trainer
from priors.training.devices import has_bfloat16
from priors.training.recipes import lstm_gmm
from priors.training.run import train

ON_GPU = [name for name in MODELS if name not in ("refiner", "keyframe-timing")]

pytestmark = pytest.mark.usefixtures("small_judgements")


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.setattr(recipe, "select_device", lambda wanted: "cpu" if wanted == "cpu" else NAME)
    with replace_gpu(monkeypatch, run, trainer, lstm_gmm):
        yield


@pytest.mark.slow
@pytest.mark.parametrize("name", list_params(ON_GPU))
def test_every_model_comes_to_the_same_on_another_device(tmp_path, data, gpu, name):
    made = MODELS[name].recipe(data, tmp_path / "here", None)
    made = replace(made, settings=replace(made.settings, steps=3), validate_steps=3)
    for out, device in (("here", "cpu"), ("there", "auto")):
        train(replace(made, out=tmp_path / out, device=device))
    here, there = (load_file(tmp_path / out / "model.safetensors") for out in ("here", "there"))
    assert here.keys() == there.keys()
    torch.testing.assert_close(there, here, rtol=0.02, atol=0.002)
    curves = [json.loads((tmp_path / out / "model.json").read_text())["training"]["curve"] for out in ("here", "there")]
    assert [row.keys() for row in curves[0]] == [row.keys() for row in curves[1]]
    assert json.loads((tmp_path / "there" / "checkpoint.json").read_text())["device"] == "lazy"


def test_paces_are_followed_on_the_processor(tmp_path, data, gpu):
    made = MODELS["lstm-gmm"].recipe(data, tmp_path / "run", None)
    made = replace(made, label_pace=True, device="auto", settings=replace(made.settings, steps=2))
    train(made)
    assert json.loads((tmp_path / "run" / "model.json").read_text())["config"]["labels"][-1] == "pace=run"


@pytest.mark.slow
def test_a_run_of_one_device_goes_on_on_another_and_says_so(tmp_path, data, gpu):
    made = replace(MODELS["path"].recipe(data, tmp_path / "run", None), device="auto")
    told = []
    train(replace(made, settings=replace(made.settings, steps=3)))
    train(replace(made, device="cpu", resume=True), warn=told.append)
    (line,) = told
    assert line.endswith("run was trained on lazy and goes on on cpu: the result is as good, but another one")
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 6


@pytest.mark.slow
def test_the_state_of_another_kind_of_generator_is_not_taken(tmp_path, data):
    made = MODELS["path"].recipe(data, tmp_path / "run", None)
    train(replace(made, settings=replace(made.settings, steps=3)))
    checkpoint = json.loads((tmp_path / "run" / "checkpoint.json").read_text())
    path = tmp_path / "run" / checkpoint["tensors"]
    tensors = load_file(path)
    tensors["generator"] = torch.zeros(16, dtype=torch.uint8)  # as CUDA's is
    save_file(tensors, path)
    train(replace(made, resume=True))
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 6


@pytest.mark.parametrize("name", list_params(["refiner", "keyframe-timing", "tweener with a critic"]))
def test_models_that_a_gpu_does_not_help_are_trained_without(tmp_path, data, prior, gpu, name):
    wanted = (MODELS | VARIANTS)[name].recipe(data, tmp_path / "run", prior)
    assert wanted.find_device() == "cpu"
    with pytest.raises(RequestError, match="not trained on GPUs; use --device cpu"):
        train(replace(wanted, device="cuda"))


def test_a_gpu_that_is_not_there_is_told(tmp_path, data, capsys):
    words = ("train", "path", "--data", data, "-o", tmp_path / "run", "--device", "cuda")
    if torch.cuda.is_available():
        pytest.skip("there is one")
    assert mapctl_run(*words) == 2
    assert capsys.readouterr().err == "mapctl: this machine has no CUDA device; use --device cpu\n"


def test_several_processes_on_a_gpu_are_left_to_torchrun(tmp_path, data, monkeypatch):
    monkeypatch.setattr(recipe, "select_device", lambda wanted: "cuda")
    made = replace(MODELS["path"].recipe(data, tmp_path / "run", None), processes=2)
    with pytest.raises(RequestError, match="started by torchrun, one a GPU"):
        train(made)


def test_the_pretended_device_refuses_what_a_gpu_refuses():
    here = torch.ones(3)
    with pretend_device():
        there = torch.arange(3.0)
        assert there.device.type == "lazy"
        assert (there * here.sum() + there[torch.tensor([2, 0, 1], device="cpu")]).tolist() == [2.0, 3.0, 7.0]
        with pytest.raises(RuntimeError, match="tensors of two devices"):
            there + here
        with pytest.raises(TypeError, match="no array"):
            there.numpy()


@pytest.mark.parametrize("has", [True, False])
def test_a_processor_without_bfloat16_computes_in_float32_and_says_so(tmp_path, data, monkeypatch, has):
    monkeypatch.setattr(run, "has_bfloat16", lambda: has)
    made = MODELS["path"].recipe(data, tmp_path / "run", None)
    made, told, seen = replace(made, settings=replace(made.settings, steps=2, bfloat16=True)), [], []
    monkeypatch.setattr(run.TrainingRun, "go", lambda self: seen.append(self.recipe.settings.bfloat16))
    monkeypatch.setattr(run.TrainingRun, "export", lambda self: self.recipe.out)
    train(made, warn=told.append)
    assert seen == [has]
    assert told == ([] if has else ["this processor does not compute in bfloat16; training computes in float32"])


@pytest.mark.parametrize("first", ["bfloat16", "float32"])
def test_a_run_may_go_on_in_the_other_precision_and_says_so(tmp_path, data, monkeypatch, first):
    made, told = MODELS["path"].recipe(data, tmp_path / "run", None), []
    for resume, precision, steps in ((False, first, 2), (True, first, 3), (True, "other", 4)):
        monkeypatch.setattr(run, "has_bfloat16", lambda: True)
        bfloat16 = (precision == "bfloat16") if precision != "other" else first != "bfloat16"
        train(
            replace(made, resume=resume, settings=replace(made.settings, steps=steps, bfloat16=bfloat16)),
            warn=told.append,
        )
    other = {"bfloat16": "float32", "float32": "bfloat16"}[first]
    (line,) = told
    assert line.endswith(f"run was trained in {first} and goes on in {other}: the result is as good, but another one")


@pytest.mark.parametrize(
    ("capabilities", "has"),
    [
        ({"avx512_f": True, "avx512_bw": True, "avx512_vl": True, "avx512_dq": True}, False),
        ({"avx512_bf16": True}, True),
        ({"amx_bf16": True}, True),
        ({"avx2": True}, False),
    ],
)
def test_a_processor_is_known_by_its_capabilities(monkeypatch, capabilities, has):
    monkeypatch.setattr(
        torch.cpu, "get_capabilities", lambda: {"architecture": "x86_64", **capabilities}, raising=False
    )
    has_bfloat16.cache_clear()
    assert has_bfloat16() is has
    has_bfloat16.cache_clear()


def test_a_gpu_is_asked_for_bfloat16_whatever_the_processor_has(tmp_path, data, monkeypatch):
    monkeypatch.setattr(run, "has_bfloat16", lambda: False)
    monkeypatch.setattr(recipe, "select_device", lambda wanted: "cuda")
    made = MODELS["path"].recipe(data, tmp_path / "run", None)
    made = replace(made, settings=replace(made.settings, bfloat16=True))
    assert run._fit_precision(made, pytest.fail) is made


def test_this_processor_is_asked_once_and_trains_either_way(tmp_path, data):
    """An LSTM in bfloat16 ends with an error of torch on processors without it."""
    assert has_bfloat16() is has_bfloat16()
    made = MODELS["lstm-gmm"].recipe(data, tmp_path / "run", None)
    train(replace(made, settings=replace(made.settings, steps=2, bfloat16=True)))
    told = json.loads((tmp_path / "run" / "model.json").read_text())["training"]["command"]
    assert ("--bfloat16" in told) is has_bfloat16()
