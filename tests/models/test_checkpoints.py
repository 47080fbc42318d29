"""Weights on disk: they come back, and whatever does not fit is refused in one line."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import tiny_density
from tiny_denoiser import save_tiny_denoiser
from tiny_infiller import save_tiny_infiller
from tiny_path import save_tiny_path
from tiny_stitcher import save_tiny_stitcher
from tiny_transformer import save_tiny_transformer

import priors
from mapctl.errors import CheckpointError
from mapctl.features import LAYOUT
from priors import checkpoints
from priors.checkpoints import Card

DENSITY = tiny_density()


def write(folder: Path, *, card: Card = DENSITY.card, drop: str = "", half: bool = False) -> Path:
    """The tiny density as a training run leaves it."""
    state = DENSITY.initial_states.state
    tensors = dict(DENSITY.reference.state_dict())
    tensors |= {"starts.previous": state.last_frame, "starts.hidden": state.hidden, "starts.cell": state.cell}
    tensors |= {"starts.speed": DENSITY.initial_states.speed, "starts.weight": DENSITY.initial_states.weight}
    tensors.pop(drop, None)
    checkpoints.save(tensors, card, folder / "model.safetensors", half=half)
    return folder / "model.safetensors"


def refused(path, *, match):
    with pytest.raises(CheckpointError, match=match) as caught:
        priors.load(str(path))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_card_with_a_number_that_is_none_is_not_written(tmp_path):
    card = replace(DENSITY.card, quality={"nats": math.nan})
    with pytest.raises(CheckpointError, match=r"cannot write .*tiny\.safetensors: .* not finite"):
        checkpoints.save({"a": torch.ones(1)}, card, tmp_path / "tiny.safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("half", [False, True])
def test_weights_and_card_come_back(tmp_path, half):
    path = write(tmp_path, half=half)
    tensors, card = checkpoints.load(path)
    assert card == DENSITY.card
    for name, value in DENSITY.reference.state_dict().items():
        assert tensors[name].dtype is torch.float32
        exact = not half or name in ("mean", "std")
        torch.testing.assert_close(tensors[name], value, rtol=0 if exact else 1e-3, atol=0 if exact else 1e-6)


@pytest.mark.parametrize("named", ["file", "folder", "stem"])
def test_a_prior_is_found_by_file_folder_or_stem(tmp_path, named):
    path = write(tmp_path)
    asked = {"file": path, "folder": tmp_path, "stem": path.with_suffix("")}[named]
    loaded = priors.load(str(asked))
    assert loaded.initial_states.names == DENSITY.initial_states.names
    torch.testing.assert_close(loaded.initial_states.state.hidden, DENSITY.initial_states.state.hidden)
    frames = DENSITY.initial_states.state.last_frame[:1].expand(3, -1)[None]
    state = DENSITY.initial_states.state.pick(torch.tensor([0]))
    torch.testing.assert_close(loaded.log_prob(frames, state), DENSITY.log_prob(frames, state))
    assert loaded.limits == DENSITY.limits
    assert not any(p.requires_grad for p in loaded.reference.parameters())


def test_another_layout_is_refused_with_both_printed(tmp_path):
    other = [["root", 7], ["contacts", 2]]
    path = write(tmp_path, card=replace(DENSITY.card, layout=other, fingerprint="0123456789ab"))
    message = refused(path, match="its features are")
    assert str(other) in message
    assert str([list(block) for block in LAYOUT.blocks]) in message


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"kind": "refiner"}, "a refiner is no density"),
        ({"config": {**DENSITY.card.config, "width": 9}}, "do not fit its card"),
        ({"config": {**DENSITY.card.config, "depth": 3}}, "do not fit its card"),
        ({"config": {**DENSITY.card.config, "width": "wide"}}, "do not fit its card"),
        ({"data": {}}, "do not fit its card"),
        ({"abilities": {"fastest": 1.0}}, "do not fit its card"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(tmp_path, changes, match):
    refused(write(tmp_path, card=replace(DENSITY.card, **changes)), match=match)


@pytest.mark.parametrize("missing", ["out.bias", "mean", "starts.hidden"])
def test_missing_tensors_are_refused(tmp_path, missing):
    refused(write(tmp_path, drop=missing), match="do not fit its card")


@pytest.mark.parametrize("content", [b"", b"\x08" + b"\0" * 20, b"not safetensors", "cut"], ids=repr)
def test_a_broken_file_is_refused(tmp_path, content):
    path = write(tmp_path)
    path.write_bytes(path.read_bytes()[:-100] if content == "cut" else content)
    refused(path, match="no readable safetensors file")


@pytest.mark.parametrize("content", ["", "[1]", "{}", "{", '"card"', b"\xff\xfe"], ids=repr)
def test_a_broken_card_is_refused(tmp_path, content):
    path = write(tmp_path)
    path.with_suffix(".json").write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(path, match="no readable card")


class Trap:
    """Unpickling it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_is_unpickled(tmp_path):
    path, sprung = write(tmp_path), tmp_path / "sprung"
    torch.save(Trap(sprung), path)
    refused(path, match="no readable safetensors file")
    assert not sprung.exists()


@pytest.mark.parametrize("name", ["no-such-prior", "", ".", "..", "/", "a/b.txt"])
def test_an_unknown_name_is_answered_with_the_bundled_ones(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(name, match="no prior")


def test_a_failed_save_leaves_the_old_weights(tmp_path):
    path = write(tmp_path)
    before = path.read_bytes()
    tied = torch.zeros(4)
    with pytest.raises(RuntimeError):
        checkpoints.save({"a": tied, "b": tied}, DENSITY.card, path, half=False)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.json", "model.safetensors"]


@pytest.mark.parametrize(
    ("kind", "save", "load"),
    [
        ("denoiser", save_tiny_denoiser, priors.load_denoiser),
        ("infiller", save_tiny_infiller, priors.load_infiller),
        ("path", save_tiny_path, priors.load_path),
        ("pose-transformer", save_tiny_transformer, priors.load_transformer),
        ("stitcher", save_tiny_stitcher, priors.load_stitcher),
    ],
)
def test_a_network_loads_by_file_or_folder_and_no_other_kind_or_shape_does(tmp_path, kind, save, load):
    folder = tmp_path / "run"
    folder.mkdir()
    path = save(folder / "model.safetensors")
    tensors, card = checkpoints.load(path)
    for name in (path, folder):
        model = load(str(name))
        assert (model.name, model.card.kind, str(name) in repr(model)) == (str(name), kind, True)
        assert all(torch.equal(value, tensors[key]) for key, value in model.network.state_dict().items())
        assert not any(parameter.requires_grad for parameter in model.network.parameters())
    checkpoints.save(tensors, replace(card, kind="critic"), path)
    with pytest.raises(CheckpointError, match="a critic is no"):
        load(str(path))
    checkpoints.save(dict(list(tensors.items())[1:]), card, path)
    with pytest.raises(CheckpointError, match="do not fit its card"):
        load(str(path))
