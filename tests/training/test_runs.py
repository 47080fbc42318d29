"""What holds for the run of any model: it resumes, stops early, refuses what does not fit, and leaves a loadable model
with its card. Models are trained on five synthetic clips, for six steps.
"""

import csv
import json
import math
from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch
from helpers import killing, run, write_corpus
from safetensors.torch import load_file, save_file
from trainable_models import MODELS, list_params

from mapctl import cli
from mapctl.commands.train import KINDS
from mapctl.errors import CheckpointError, MapctlError, RequestError
from priors import checkpoints
from priors.training import loop as runs
from priors.training.loop import train, warmup_cosine

pytestmark = pytest.mark.usefixtures("small_judgements")
NAMES = list_params(MODELS)
NETWORKS = list_params(name for name in MODELS if name not in ("keyframe-timing", "refiner"))


@pytest.fixture(scope="module")
def finished(data, prior, tmp_path_factory):
    """Finished runs by model, each made once."""
    made = {}

    def finish(name):
        if name not in made:
            out = tmp_path_factory.mktemp("runs") / name
            train(MODELS[name].recipe(data, out, prior))
            made[name] = out
        return made[name]

    return finish


def read_log(out):
    with (out / runs.LOSSES).open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", NAMES)
def test_a_finished_run_is_a_model_with_a_card_and_a_log(name, finished):
    out = finished(name)
    with checkpoints.open_checkpoint(str(out), name) as (tensors, card):
        assert all(bool(value.isfinite().all()) for value in tensors.values())
    assert [row["step"] for row in card.training["curve"]][-3:] == [2, 4, 6]
    assert card.training["settings"]["steps"] == 6
    assert card.data["trained_on"]["clips"] == 3
    assert card.licence == "that of the training data"
    assert [int(row["step"]) for row in read_log(out) if row["part"] == runs.VALIDATION][-3:] == [2, 4, 6]
    made = {path.name for path in out.iterdir()} - {runs.EVENTS}
    assert made == {"cache", runs.CHECKPOINT, runs.LOSSES, "model.json", "model.safetensors"}


@pytest.mark.parametrize("name", NAMES)
def test_a_run_that_was_killed_goes_on_to_the_same_weights(name, finished, data, prior, tmp_path):
    recipe = replace(MODELS[name].recipe(data, tmp_path / "run", prior), checkpoint_minutes=0.0)
    with killing(MODELS[name].trainer, 3):
        train(recipe)
    with pytest.raises(RequestError, match="pass --resume"):
        train(recipe)
    train(replace(recipe, resume=True))
    wanted, found = (load_file(out / "model.safetensors") for out in (finished(name), tmp_path / "run"))
    assert all(torch.equal(wanted[key], found[key]) for key in wanted)
    steps = [[(row["step"], row["part"]) for row in read_log(out)] for out in (finished(name), tmp_path / "run")]
    assert steps[0] == steps[1]


@pytest.mark.parametrize("name", NAMES)
def test_a_run_goes_on_with_its_own_settings_and_clips_alone(name, finished, data, prior, tmp_path):
    recipe = replace(MODELS[name].recipe(data, finished(name), prior), resume=True)
    with pytest.raises(CheckpointError, match=r"begun with other settings \(.*seed: 1 then, 2 now"):
        train(replace(recipe, settings=replace(recipe.settings, seed=2)))
    with pytest.raises(CheckpointError, match="begun with other data"):
        train(replace(recipe, data=write_corpus(tmp_path / "others", 6)))
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        train(replace(recipe, out=tmp_path / "nothing"))
    with pytest.raises(RequestError, match="6 steps are done; --steps must be at least that, got 4"):
        train(replace(recipe, settings=replace(recipe.settings, steps=4)))


@pytest.mark.parametrize("damage", ["nothing", "half", "no tensor", "no curve"])
def test_a_damaged_checkpoint_is_refused(damage, finished, data, prior, tmp_path):
    whole = finished("lstm-gmm") / runs.CHECKPOINT
    broken, tensors = tmp_path / runs.CHECKPOINT, load_file(whole)
    index = runs.read_index(whole.parent)
    if damage == "no tensor":
        del tensors["generator"]
    if damage == "no curve":
        del index["curve"]
    save_file(tensors, broken, metadata={"run": json.dumps(index)})
    if damage in ("nothing", "half"):
        content = broken.read_bytes()
        broken.write_bytes(b"" if damage == "nothing" else content[: len(content) // 2])
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        train(replace(MODELS["lstm-gmm"].recipe(data, tmp_path, prior), resume=True))


@pytest.mark.parametrize("name", NETWORKS)
def test_a_run_that_diverges_stops_and_keeps_its_last_checkpoint(name, data, prior, tmp_path, monkeypatch):
    trainer, taken = MODELS[name].trainer, MODELS[name].trainer.losses

    def broken(self):
        found = taken(self)
        return {**found, "loss": found["loss"] * (math.nan if self.step == 3 else 1.0)}

    monkeypatch.setattr(trainer, "losses", broken)
    recipe = replace(MODELS[name].recipe(data, tmp_path / "run", prior), checkpoint_minutes=0.0)
    with pytest.raises(MapctlError, match="diverged at step 4"):
        train(recipe)
    assert runs.read_index(tmp_path / "run")["step"] == 3
    assert not (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.parametrize("patience", [0, 1, 2])
def test_training_ends_where_validation_no_longer_improves_with_the_best_weights(
    patience, data, prior, tmp_path, monkeypatch
):
    name, scores = "path", {2: 3.0, 4: 5.0, 6: 4.0}
    recipe = replace(MODELS[name].recipe(data, tmp_path / "run", prior), patience=patience)
    seen = {}

    def validate(self, corpus):
        seen[self.step] = {key: value.clone() for key, value in self.network.state_dict().items()}
        return {"all_V1_cm": scores[self.step]}

    monkeypatch.setattr(MODELS[name].trainer, "validate", validate)
    train(recipe)
    card = checkpoints.read_card(tmp_path / "run" / "model.json")
    last, best = {0: (6, 6), 1: (4, 2), 2: (6, 2)}[patience]
    assert card.training["curve"][-1]["step"] == last
    assert ("ended" in card.training) == (patience > 0)
    found = load_file(tmp_path / "run" / "model.safetensors")
    assert all(
        torch.equal(found[key].float(), value.half().float())
        for key, value in seen[best].items()
        if key not in ("mean", "std")
    )


@pytest.mark.parametrize("name", NETWORKS)
def test_a_run_may_begin_with_the_weights_of_another_and_keep_a_share_of_them(name, finished, data, prior, tmp_path):
    before = finished(name)
    recipe = replace(MODELS[name].recipe(data, tmp_path / "run", prior), init=str(before))
    share = {} if name == "lstm-gmm" else {"init_share": 0.999}
    train(replace(recipe, settings=replace(recipe.settings, steps=1), **share))
    card = checkpoints.read_card(tmp_path / "run" / "model.json")
    assert card.data["init"]["name"] == before.name
    old, new = (load_file(out / "model.safetensors") for out in (before, tmp_path / "run"))
    shared = [key for key in new if key in old and not key.startswith("starts.") and old[key].is_floating_point()]
    assert shared
    assert all((old[key].float() - new[key].float()).abs().max() < 0.05 for key in shared if "temperature" not in key)


def test_an_interruption_is_explained_by_the_last_checkpoint(data, prior, tmp_path, monkeypatch, capsys):
    def interrupt(self):
        raise KeyboardInterrupt

    words = ["train", "lstm-gmm", "--data", data, "-o", tmp_path / "run", "--steps", 6, "--batch", 4, "--window", 20]
    words += ["--width", 8, "--components", 2]
    trainer, recipe = MODELS["lstm-gmm"].trainer, MODELS["lstm-gmm"].recipe(data, tmp_path / "run", prior)
    with killing(trainer, 3):
        train(replace(recipe, checkpoint_minutes=0.0))
    monkeypatch.setattr(trainer, "train_step", interrupt)
    assert run(*words, "--resume") == 130
    assert "step 3 is saved; the same command with --resume goes on" in capsys.readouterr().err
    words[5] = tmp_path / "other"
    assert run(*words) == 130
    assert "nothing was saved yet" in capsys.readouterr().err


def test_files_that_cannot_be_used_are_left_out_and_listed(data, prior, tmp_path):
    folder, lines = write_corpus(tmp_path / "data", 5), []
    (folder / "broken.bvh").write_text("HIERARCHY")
    train(MODELS["path"].recipe(folder, tmp_path / "run", prior), warn=lines.append)
    assert len(lines) == 1
    assert lines[0].startswith("left out 1 of 6 files: ")
    assert (tmp_path / "run" / "skipped.txt").read_text().startswith("broken.bvh: ")
    assert "broken.bvh" in checkpoints.read_card(tmp_path / "run" / "model.json").data["skipped"]


@pytest.mark.parametrize("name", KINDS)
def test_every_option_is_a_field_of_the_recipe_its_settings_or_its_network(name):
    words = ["--steps", "7", "--seed", "3", "--licence", "CC0", "--patience", "2", "--match", "walk", "--level"]
    if name != "keyframe-timing":
        words += ["--batch", "6", "--window", "64", "--bfloat16"]
    if name not in ("keyframe-timing", "refiner"):
        words += ["--learning-rate", "0.01", "--device", "cpu"]
    recipe = parse(name, *words).recipe()
    assert (recipe.settings.steps, recipe.settings.seed, recipe.licence, recipe.patience) == (7, 3, "CC0", 2)
    assert (recipe.match, recipe.level, recipe.resume) == ("walk", True, False)
    if name != "keyframe-timing":
        assert (recipe.settings.batch, recipe.settings.window, recipe.settings.bfloat16) == (6, 64, True)
    usual = parse(name).recipe()
    for part in ("config", "settings"):
        kind = next(field for field in fields(type(usual)) if field.name == part)
        assert getattr(usual, part) == kind.default_factory()


@pytest.mark.parametrize(
    ("name", "words", "check"),
    [
        ("lstm-gmm", "--width 8 --components 2", lambda r: (r.config.width, r.config.components) == (8, 2)),
        ("lstm-gmm", "--paper", lambda r: r.config.retain == 0 and not r.config.correlated and r.config.width == 500),
        ("lstm-gmm", "--steps 9 --critic-steps 4", lambda r: r.settings.critic_steps == 4),
        ("lstm-gmm", "--copies 3 --tempo 0.1", lambda r: (r.settings.copies, r.settings.tempo) == (3, 0.1)),
        ("lstm-gmm", "--splices 5 --stitcher mine", lambda r: (r.splices, r.stitcher) == (5, "mine")),
        ("lstm-gmm", "--standing-share 0.5 --label-pace", lambda r: r.settings.standing_share == 0.5 and r.label_pace),
        ("refiner", "--density mine --paper", lambda r: (r.density, r.config.memory) == ("mine", 1000)),
        ("denoiser", "--width 8 --angles 10", lambda r: (r.config.width, r.settings.angles) == (8, 10)),
        ("pose-transformer", "--width 96 --layers 2 --detail 3", lambda r: (r.config.heads, r.config.detail) == (3, 3)),
        ("infiller", "--architecture image", lambda r: r.config.architecture == "image"),
        ("keyframe-timing", "--pairs 2", lambda r: r.settings.pairs == 2),
        ("path", "--width 8", lambda r: r.config.width == 8),
        ("tweener", "--path mine --labels (a)", lambda r: (r.path, r.labels) == ("mine", "(a)")),
        ("tweener", "--paper", lambda r: not r.config.skips),
    ],
)
def test_options_of_one_model(name, words, check):
    assert check(parse(name, *words.split()).recipe())


@pytest.mark.parametrize(
    ("name", "words", "reason"),
    [
        ("denoiser", "--steps 0", "steps must be at least 1"),
        ("path", "--seed -1", "the seed must be"),
        ("path", "--patience -1", "patience must be at least 0"),
        ("path", "--init-share 0.5", "needs init"),
        ("denoiser", "--window 4", "window must be at least 16"),
        ("lstm-gmm", "--init locomotion --width 8", "with --init the network is that prior's"),
        ("lstm-gmm", "--steps 5 --critic-steps 5", "a critic joins the last steps"),
    ],
)
def test_options_that_make_no_sense_are_refused(name, words, reason):
    with pytest.raises(RequestError, match=reason):
        parse(name, *words.split()).recipe()


def test_what_cannot_be_trained_on_is_refused_and_nothing_written(data, prior, tmp_path):
    recipe = MODELS["refiner"].recipe(data, tmp_path / "run", prior)
    with pytest.raises(RequestError, match="is not a folder"):
        train(replace(recipe, data=tmp_path / "nowhere"))
    with pytest.raises(RequestError, match="a refiner is not trained on GPUs"):
        train(replace(recipe, device="cuda"))
    with pytest.raises(RequestError, match="device must be auto, cpu or cuda"):
        train(replace(MODELS["path"].recipe(data, tmp_path / "run", prior), device="abacus"))
    assert not (tmp_path / "run").exists()


def test_the_learning_rate_rises_and_falls_to_zero():
    rates = [warmup_cosine(step, 100) for step in range(101)]
    assert rates[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert rates[-1] == pytest.approx(0)
    assert all(one > other for one, other in pairwise(rates[5:]))


def parse(name, *words):
    return cli.parse(["train", name, "--data", "data", "-o", "run", *words])
