"""`mapctl train` of models that learn from windows, the denoiser and the infiller: runs, their options, their cards."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import tiny_denoiser
import tiny_infiller
import tiny_stitcher
import tiny_transformer
import tiny_tweener
from helpers import killing, run

import priors
from mapctl import cli
from mapctl.commands import train as commands
from mapctl.commands.train.options import TrainOptions
from mapctl.errors import CheckpointError, MapctlError, RequestError
from priors.denoiser.network import DenoiserConfig
from priors.infiller.network import InfillerConfig
from priors.pose_transformer.network import PoseTransformerConfig
from priors.stitching.network import StitcherConfig
from priors.training.recipes.denoiser import DenoiserRecipe, DenoiserSettings, DenoiserTrainer
from priors.training.recipes.infiller import InfillerRecipe, InfillerSettings, InfillerTrainer
from priors.training.recipes.path import PathRecipe, PathSettings, PathTrainer
from priors.training.recipes.pose_transformer import (
    PoseTransformerRecipe,
    PoseTransformerSettings,
    PoseTransformerTrainer,
)
from priors.training.recipes.stitcher import StitcherRecipe, StitcherSettings, StitcherTrainer
from priors.training.recipes.tweener import TweenerRecipe, TweenerSettings, TweenerTrainer
from priors.training.run import train
from priors.tweening.generator import GeneratorConfig
from priors.tweening.path import PathConfig

pytestmark = pytest.mark.usefixtures("small_judgements")


@dataclass(frozen=True)
class Model:
    """One of those that are trained so."""

    recipe: Any
    """Class of what is trained."""
    trainer: type
    """That its runs use."""
    load: Callable[[str], Any]
    """As controllers get it."""
    tiny: Any
    """Shape of a small network."""
    other: Any
    """Another shape of it."""
    usual: Any
    """Settings that are the default."""
    shape: tuple[tuple[str, ...], Any]
    """Words for another shape, and the shape."""

    @property
    def name(self) -> str:
        return self.recipe.kind

    @property
    def settings(self):
        """Six steps."""
        return replace(self.usual, steps=6, batch=3, window=32)


MODELS = (
    Model(
        DenoiserRecipe,
        DenoiserTrainer,
        priors.load_denoiser,
        tiny_denoiser.CONFIG,
        replace(tiny_denoiser.CONFIG, width=7),
        DenoiserSettings(),
        (("--width", "12"), DenoiserConfig(width=12)),
    ),
    Model(
        InfillerRecipe,
        InfillerTrainer,
        priors.load_infiller,
        tiny_infiller.CONFIG,
        replace(tiny_infiller.CONFIG, kernel=5),
        InfillerSettings(),
        (("--architecture", "image"), InfillerConfig(architecture="image")),
    ),
    Model(
        PoseTransformerRecipe,
        PoseTransformerTrainer,
        priors.load_transformer,
        tiny_transformer.CONFIG,
        replace(tiny_transformer.CONFIG, kernel=5),
        PoseTransformerSettings(),
        (("--layers", "2"), PoseTransformerConfig(layers=2)),
    ),
    Model(
        PathRecipe,
        PathTrainer,
        priors.load_path,
        PathConfig(width=4),
        PathConfig(width=5),
        PathSettings(),
        (("--width", "12"), PathConfig(width=12)),
    ),
    Model(
        TweenerRecipe,
        TweenerTrainer,
        priors.load_tweener,
        tiny_tweener.CONFIG,
        replace(tiny_tweener.CONFIG, style=6),
        TweenerSettings(),
        (("--plain",), GeneratorConfig(skips=False)),
    ),
    Model(
        StitcherRecipe,
        StitcherTrainer,
        priors.load_stitcher,
        tiny_stitcher.CONFIG,
        replace(tiny_stitcher.CONFIG, encoder=6),
        StitcherSettings(),
        (("--without", "d"), StitcherConfig(without=("d",))),
    ),
)


QUICK = "path", "denoiser"


@pytest.fixture(
    params=[
        pytest.param(model, marks=() if model.name in QUICK else pytest.mark.slow, id=model.name) for model in MODELS
    ]
)
def model(request):
    return request.param


@pytest.fixture
def request_in(data, model):
    """Checkpoints in every step, so that a kill can come anywhere."""

    def made(out, **changes):
        settings = replace(model.settings, **changes.pop("settings", {}))
        given = {"checkpoint_minutes": 0.0, "report_steps": 2, "validate_steps": 4, "config": model.tiny} | changes
        return model.recipe(data, out, settings=settings, **given)

    return made


def killed_in(model, request, number):
    """Runs until a step is begun."""
    with killing(model.trainer, number):
        train(request)


def test_killed_and_resumed_is_the_uninterrupted_run_to_the_bit(tmp_path, model, request_in):
    whole = train(request_in(tmp_path / "whole"))
    killed_in(model, request_in(tmp_path / "parts"), 3)
    killed_in(model, request_in(tmp_path / "parts", resume=True), 4)
    news = []
    parts = train(request_in(tmp_path / "parts", resume=True), news.append)
    assert "resumed at step 4" in news
    for name in (whole.name, "model.json", "step-6-checkpoint.safetensors", "checkpoint.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert parts == tmp_path / "parts" / "model.safetensors"


@pytest.mark.slow
def test_a_finished_run_loads_with_a_complete_card(tmp_path, model, request_in):
    news, out = [], tmp_path / "run"
    train(request_in(out, licence="CC0"), news.append)
    found = model.load(str(out))
    card = found.card
    assert (card.kind, card.licence, found.network.config) == (model.name, "CC0", model.tiny)
    assert (card.data["clips"], card.data["frames"]) == ("5", "400")
    assert card.training["settings"] == json.loads(json.dumps(asdict(model.settings)))
    assert [row["step"] for row in card.training["curve"]] == [4, 6]
    assert all(math.isfinite(value) for value in card.quality["test"].values())
    assert set(card.data["held_out"]) == {"validation", "test"}
    assert [line.split(":")[0] for line in news if line.startswith("step")] == ["step 2/6", "step 4/6", "step 6/6"]


@pytest.mark.slow
def test_resuming_is_asked_for_and_needs_the_same_recipe_network_and_data(tmp_path, model, request_in):
    out = tmp_path / "run"
    with pytest.raises(CheckpointError, match="no checkpoint to resume"):
        train(request_in(out, resume=True))
    killed_in(model, request_in(out), 2)
    with pytest.raises(RequestError, match="already holds a run; pass --resume"):
        train(request_in(out))
    with pytest.raises(CheckpointError, match=r"other settings \(learning_rate: .* then, 0\.3 now\)"):
        train(request_in(out, resume=True, settings={"learning_rate": 0.3}))
    with pytest.raises(CheckpointError, match=r"other network \((width|kernel|style|encoder): \d then, \d now\)"):
        train(request_in(out, resume=True, config=model.other))
    with pytest.raises(CheckpointError, match="other data"):
        train(request_in(out, resume=True, match="walk-[0-3]"))


def test_what_cannot_be_trained_on_is_refused(tmp_path, model, request_in):
    with pytest.raises(RequestError, match="not a folder of BVH"):
        train(replace(request_in(tmp_path / "run"), data=tmp_path / "nowhere"))
    with pytest.raises(RequestError, match=r"no .bvh below .* matches 'dance'"):
        train(request_in(tmp_path / "run", match="dance"))
    for wrong in ({"window": 15}, {"steps": 0}, {"batch": 0}):
        with pytest.raises(RequestError, match=f"{next(iter(wrong))} must be at least"):
            replace(model.settings, **wrong)
    assert not (tmp_path / "run" / "checkpoint.json").exists()


@pytest.mark.slow
def test_a_run_may_begin_with_the_weights_of_another(tmp_path, model, request_in):
    first = train(request_in(tmp_path / "first"))
    wanted = replace(request_in(tmp_path / "second"), init=str(first))
    killed_in(model, wanted, 2)  # at the step after its second checkpoint
    train(replace(wanted, resume=True))
    card = model.load(str(tmp_path / "second")).card
    assert "--init INIT" in card.training["command"]
    own = train(request_in(tmp_path / "own"))
    assert own.read_bytes() == first.read_bytes() != (tmp_path / "second" / "model.safetensors").read_bytes()
    again = request_in(tmp_path / "second", resume=True)
    with pytest.raises(CheckpointError, match="other init"):
        train(again)
    with pytest.raises(CheckpointError, match=f"wanted: {model.name}"):
        train(replace(request_in(tmp_path / "third", config=model.other), init=str(first)))


def test_a_diverged_run_stops_with_its_last_checkpoint(tmp_path, model, request_in, monkeypatch):
    losses = model.trainer.losses
    monkeypatch.setattr(
        model.trainer,
        "losses",
        lambda trainer: {
            name: value * (math.nan if trainer.step == 2 else 1) for name, value in losses(trainer).items()
        },
    )
    with pytest.raises(MapctlError, match=r"diverged at step 3: the loss is nan; the last checkpoint, .* is kept"):
        train(request_in(tmp_path / "run"))
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 2
    assert not (tmp_path / "run" / "model.safetensors").exists()


def requested(model, *words):
    given = cli.parse(["train", model.name, "--data", "data", "-o", "run", *words])
    assert isinstance(given, TrainOptions)
    return given.recipe()


def test_every_option_reaches_the_trainer(model):
    given = requested(model)
    assert (given.config, given.settings) == (type(model.tiny)(), model.usual)
    assert (given.data, given.out, given.match, given.resume) == (Path("data"), Path("run"), None, False)
    words, config = model.shape
    given = requested(
        model,
        "--match",
        "walk",
        "--steps",
        "7",
        "--batch",
        "6",
        "--window",
        "40",
        "--seed",
        "0",
        "--learning-rate",
        "0.01",
        "--bfloat16",
        "--resume",
        "--licence",
        "CC0",
        "--skip-first",
        "--minutes-between-checkpoints",
        "0.5",
        *words,
    )
    assert (given.match, given.resume, given.licence, given.skip_first) == ("walk", True, "CC0", True)
    assert (given.checkpoint_minutes, given.config) == (0.5, config)
    assert given.settings == replace(
        model.usual, steps=7, batch=6, window=40, seed=0, learning_rate=0.01, bfloat16=True
    )


@pytest.mark.parametrize("words", [["--density", "mine"], ["--components", "3"]], ids=lambda words: words[0])
def test_options_of_other_models_are_unknown(model, words):
    with pytest.raises(RequestError, match=f"Unrecognized options: {words[0]}.* .see mapctl train {model.name} --help"):
        requested(model, *words)


def test_a_shape_that_only_another_model_has_is_unknown(model):
    own_words = {"infiller", "tweener"}  # both have an architecture
    other = next(each for each in MODELS if each.name == ("denoiser" if model.name in own_words else "infiller"))
    with pytest.raises(RequestError, match=f"Unrecognized options: {other.shape[0][0]}"):
        requested(model, *other.shape[0])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--steps", "0"], "--steps must be at least 1, got 0"),
        (["--batch", "-2"], "--batch must be at least 1"),
        (["--window", "0"], "--window must be at least 1"),
        (["--window", "8"], "window must be at least"),
        (["--seed", "-1"], "seed"),
        (["--learning-rate", "2"], "learning rate"),
        (["--learning-rate", "0"], "learning"),
        (["--minutes-between-checkpoints", "0"], "minutes between"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_numbers_that_make_no_sense_are_refused(model, words, message):
    with pytest.raises(RequestError, match=message):
        requested(model, *words)


def test_the_command_of_a_card_asks_for_the_same_run(tmp_path, data, model):
    settings = replace(model.usual, steps=7, bfloat16=True, seed=3, learning_rate=2e-4)
    wanted = model.recipe(data, tmp_path, match="walk-[01]", config=model.shape[1], settings=settings, skip_first=True)
    words = wanted.format_command().replace("'", "").replace("DATA", str(data)).replace("RUN", str(tmp_path))
    given = cli.parse(words.split()[1:])
    assert isinstance(given, TrainOptions)
    assert given.recipe() == wanted


@pytest.mark.slow
def test_the_command_line_trains_what_can_be_loaded(tmp_path, data, model, capsys):
    out, (words, config) = tmp_path / "run", model.shape
    assert run("train", model.name, "--data", data, "-o", out, "--steps", 2, "--batch", 2, "--window", 32, *words) == 0
    told = capsys.readouterr()
    assert told.err == ""
    used_by = next(kind.used_by for kind in commands.MODELS if kind.model == model.name)
    assert told.out.endswith(f"wrote {out / 'model.safetensors'}; {used_by} {out}\n")
    assert model.load(str(out)).network.config == config
