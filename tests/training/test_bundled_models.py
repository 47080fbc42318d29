"""The table of the models that come with mapctl: commands, cards, pages and the folder of weights agree with it."""

import json
import math
import re
import shlex
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from ended_models import MODELS

import priors
from mapctl import cli
from mapctl.commands.train.options import TrainOptions
from mapctl.errors import CheckpointError, RequestError
from priors import checkpoints
from priors.checkpoints import Card
from priors.licences import OF_DATA
from priors.training.bundled.models import DATA, RECIPES, RUN, SETS, list_models
from priors.training.bundled.weights import MOST_BYTES, copy_model, name_needs, read_finished
from priors.training.mocap.cuts import CMU
from priors.training.run import train
from priors.weight_sets import STAND_INS

WEIGHTS = Path(checkpoints.__file__).parent / "weights"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "guides" / "training.md"
FULL = list_models()
FOLDERS = {"": FULL, "free/": list_models("free")}


def named(name, models=FULL):
    return next(model for model in models if model.name == name)


@pytest.mark.parametrize("weights", SETS)
@pytest.mark.parametrize("seed", [1, 2])
def test_each_command_asks_for_the_recipe_of_the_table(weights, seed):
    for model in list_models(weights, seed=seed):
        given = cli.parse(shlex.split(model.command)[1:])
        assert isinstance(given, TrainOptions)
        assert given.recipe() == replace(model.recipe, licence=OF_DATA), model.name


def test_all_that_is_bundled_is_in_it_after_what_it_needs():
    names = [model.name for model in FULL]
    assert sorted(names) == checkpoints.list_bundled()
    for model in FULL:
        assert all(names.index(need) < names.index(model.name) for need in model.needs.values())
    assert {model.recipe.kind for model in FULL} <= set(RECIPES)
    assert named("locomotion-refiner").needs == {"--density": "locomotion"}
    assert named("tweener").needs == {"--path": "path"}


def test_both_sets_together_are_as_small_as_is_promised():
    assert sum(file.stat().st_size for file in WEIGHTS.rglob("*") if file.is_file()) <= MOST_BYTES


bundled = pytest.mark.parametrize(
    ("folder", "model"),
    [
        pytest.param(folder, model, id=folder + model.name)
        for folder, models in FOLDERS.items()
        for model in models
        if (WEIGHTS / folder / f"{model.name}.json").exists()  # the free set has some of its models only
    ],
)


@bundled
def test_a_bundled_card_names_the_command_or_says_that_it_was_made_otherwise(folder, model):
    card = checkpoints.read_card(checkpoints.locate(folder + model.name).with_suffix(".json"))
    assert card.kind == model.recipe.kind
    command = re.sub(r" --decay-from \d+:\d+", "", card.training["command"])  # which tells where a clock ended a run
    spellings = model.command, model.command.replace(" --bfloat16", "")  # where a processor has none
    assert command in spellings or len(card.training["remark"]) > 40


@bundled
def test_what_is_bundled_was_trained_as_the_recipe_is_now(folder, model):
    """But for numbers of less precision, and for settings that are newer than the model and of no effect on it."""
    card = checkpoints.read_card(checkpoints.locate(folder + model.name).with_suffix(".json"))
    settings = json.loads(json.dumps(asdict(model.recipe.settings)))
    free = {"bfloat16"} | ({"steps", "learning_rate"} if "--init-share" in card.training["command"] else set())
    for name, value in card.training["settings"].items():
        now = settings[name]
        same = (
            value.items() <= now.items()
            if isinstance(value, dict) and not card.training.get("remark")
            else value == now
        )
        assert same or name in free, name


def test_the_page_shows_each_command():
    text = PAGE.read_text(encoding="utf-8")
    for model in FULL:
        assert model.command in text, model.name


def test_nothing_is_begun_with_other_weights():
    for model in (*FULL, *list_models("free")):
        assert getattr(model.recipe, "init", None) is None
        assert "--init" not in model.command


def test_the_free_set_sees_takes_of_cmu_alone_without_their_first_frames():
    free = list_models("free")
    assert {model.name for model in FULL} - {model.name for model in free} == set(STAND_INS)
    assert set(STAND_INS.values()) <= {model.name for model in free} <= {model.name for model in FULL}
    for model in free:
        if model.name == "locomotion-refiner":  # has its density's
            assert model.recipe.match is None
        else:
            assert model.recipe.match.startswith("^cmu")
        assert model.recipe.cuts == CMU
        assert model.recipe.level == (model.name != "denoiser")
        assert model.recipe.licence == "free for any use"
    assert {model.recipe.licence for model in FULL} == {"CC BY-NC 4.0"}


def test_walks_of_ones_own_have_no_labels():
    own = list_models(match="stroll")
    assert [named(name, own).recipe.match for name in ("locomotion", "locomotion-live")] == ["stroll", "stroll"]
    assert named("locomotion", own).recipe.labels == ""
    assert named("general", own) == named("general")


def test_another_seed_keeps_the_same_clips_from_training():
    for model in list_models(seed=3):
        assert model.recipe.settings.seed == 3
        if model.name != "locomotion-refiner":
            assert model.recipe.split_seed == 1
            assert "--seed 3" in model.command
            assert "--split-seed 1" in model.command
    with pytest.raises(RequestError, match="the weights are full or free, got 'cheap'"):
        list_models("cheap")


@pytest.mark.parametrize("name", ["denoiser", "path", "locomotion", "stitcher", "transformer", "tweener"])
def test_the_bundled_cards_tell_how_good_they_are(name):
    finished = read_finished(name, checkpoints.locate(name))
    value, what = finished.quality
    assert math.isfinite(value)
    assert what
    assert finished.steps > 1000
    assert finished.find_change(finished) == 0.0


def test_a_card_calls_what_a_model_needed_by_its_name():
    made = {"density": "/home/me/set/locomotion", "clips": "3"}
    typed = named("locomotion-refiner").command.replace("--density ", "--density /home/me/set/")
    card = Card("refiner", {}, licence="", data=made, training={"command": typed}, **Card.layout_fields())
    named_card = name_needs(card, {"--density": "locomotion"})
    assert named_card.data == {"density": "locomotion", "clips": "3"}
    assert named_card.training["command"] == named("locomotion-refiner").command
    assert card.data["density"] == made["density"] == "/home/me/set/locomotion"
    card = replace(card, training={"command": f"{named('tweener').command} --path PATH"}, data={})
    assert name_needs(card, {"--path": "path"}).training["command"] == named("tweener").command
    assert name_needs(card, {}) == card


@pytest.mark.slow  # four models are trained
def test_a_copied_model_names_what_it_needed_and_loads(tmp_path, data, prior):
    """As tiny models: a refiner by a density's folder, a tweener by a path predictor's."""
    density = train(MODELS["lstm-gmm"].recipe(data, tmp_path / "locomotion", prior)).parent
    refiner = train(MODELS["refiner"].recipe(data, tmp_path / "locomotion-refiner", str(density))).parent
    path = train(MODELS["path"].recipe(data, tmp_path / "path", prior)).parent
    tweener = replace(MODELS["tweener"].recipe(data, tmp_path / "tweener", prior), path=str(path))
    train(tweener)
    for run in (density, refiner, path, tweener.out):
        copy_model(named(run.name), run, tmp_path / "weights")
    cards = {file.stem: json.loads(file.read_text()) for file in (tmp_path / "weights").glob("*.json")}
    assert cards["locomotion-refiner"]["data"]["density"] == "locomotion"
    assert "--density locomotion --" in cards["locomotion-refiner"]["training"]["command"]
    assert "--path" in json.loads((tweener.out / "model.json").read_text())["training"]["command"]
    assert "--path" not in cards["tweener"]["training"]["command"]
    assert str(tmp_path) not in json.dumps(cards)
    weights = tmp_path / "weights"
    assert priors.load(str(weights / "locomotion.safetensors")).card.kind == "lstm-gmm"
    assert priors.load_refiner(str(weights / "locomotion-refiner.safetensors")).card.kind == "refiner"
    priors.load_tweener(str(weights / "tweener.safetensors"), str(weights / "path.safetensors"))
    for run in (density, refiner, path, tweener.out):
        own = (run / "model.safetensors").read_bytes()
        assert (weights / f"{run.name}.safetensors").read_bytes() == own


def test_a_damaged_set_is_named(tmp_path):
    (tmp_path / "path.json").write_text("{}")
    with pytest.raises(CheckpointError, match="no readable card"):
        read_finished("path", tmp_path / "path.safetensors")


def test_folders_of_the_table_are_placeholders():
    assert {(model.recipe.data, model.recipe.out) for model in FULL} == {(DATA, RUN)}
