"""Contract of any trainable model: it trains from its command, resumes, stops early, refuses what does not fit, and
leaves a loadable model with its card. Models are trained on five synthetic clips, for six steps.
"""

import csv
import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from helpers import killing, run, write_corpus
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from trainable_models import list_params, small_settings

import priors
from mapctl import cli
from mapctl.commands.train import RECIPES, load_recipe
from mapctl.errors import CheckpointError, MapctlError, RequestError
from priors import checkpoints
from priors.training import loop
from priors.training.loop import GradientTrainer, train, warmup_cosine

pytestmark = pytest.mark.usefixtures("small_judgements")
NETWORKS = [name for name in RECIPES if name not in ("keyframe-timing", "refiner")]
LOADED = {
    "lstm-gmm": priors.load,
    "refiner": priors.load_refiner,
    "denoiser": priors.load_denoiser,
    "infiller": priors.load_infiller,
    "pose-transformer": priors.load_transformer,
    "keyframe-timing": priors.load_keyframe_timing,
    "path": priors.load_path,
    "tweener": priors.load_tweener,
    "stitcher": priors.load_stitcher,
}


@pytest.fixture(scope="module")
def finished(data, prior, tmp_path_factory):
    """Finished runs by model, each trained once."""
    done = {}

    def finish(name):
        if name not in done:
            out = tmp_path_factory.mktemp("runs") / name
            assert small_settings(name, data, out, prior).run() == 0
            done[name] = out
        return done[name]

    return finish


def read_log(out):
    with (out / loop.LOSSES).open() as file:
        return list(csv.DictReader(file))


def read_step(out):
    with safe_open(out / loop.CHECKPOINT, framework="pt") as file:
        return json.loads(file.metadata()["run"])["step"]


@pytest.mark.parametrize("name", list_params())
def test_a_finished_run_is_a_model_that_loads_with_its_card_and_a_log(name, finished):
    out = finished(name)
    LOADED[name](str(out))
    with checkpoints.open_checkpoint(str(out), name) as (tensors, card):
        assert all(bool(value.isfinite().all()) for value in tensors.values())
    assert [row["step"] for row in card.training["curve"]][-3:] == [2, 4, 6]
    assert card.training["settings"]["steps"] == 6
    assert card.data["trained_on"]["clips"] == 3
    assert card.licence == "that of the training data"
    assert [int(row["step"]) for row in read_log(out) if row["part"] == loop.VALIDATION][-3:] == [2, 4, 6]
    files = {path.name for path in out.iterdir()}
    assert files == {"cache", loop.CHECKPOINT, loop.LOSSES, "model.json", "model.safetensors"}


@pytest.mark.parametrize("name", list_params())
def test_a_run_that_was_killed_goes_on_to_the_same_weights(name, finished, data, prior, tmp_path):
    settings = small_settings(name, data, tmp_path / "run", prior, checkpoint_minutes=0.0)
    with killing(load_recipe(name), 3):
        train(settings)
    with pytest.raises(RequestError, match="pass --resume"):
        train(settings)
    train(replace(settings, resume=True))
    wanted, found = (load_file(out / "model.safetensors") for out in (finished(name), tmp_path / "run"))
    assert all(torch.equal(wanted[key], found[key]) for key in wanted)
    steps = [[(row["step"], row["part"]) for row in read_log(out)] for out in (finished(name), tmp_path / "run")]
    assert steps[0] == steps[1]


@pytest.mark.parametrize("name", list_params())
def test_a_run_goes_on_with_its_own_settings_and_clips_alone(name, finished, data, prior, tmp_path):
    settings = small_settings(name, data, finished(name), prior, resume=True)
    with pytest.raises(CheckpointError, match=r"begun with other settings \(.*seed: 1 then, 2 now"):
        train(replace(settings, seed=2))
    with pytest.raises(CheckpointError, match="begun with other data"):
        train(replace(settings, data=write_corpus(tmp_path / "others", 6)))
    with pytest.raises(RequestError, match="6 steps are done; --steps must be at least that"):
        train(replace(settings, steps=4))
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        train(replace(settings, out=tmp_path / "nothing"))


@pytest.mark.parametrize("damage", ["empty", "half", "no tensor"])
def test_a_damaged_checkpoint_is_refused(damage, finished, data, tmp_path):
    whole = finished("lstm-gmm") / loop.CHECKPOINT
    content = whole.read_bytes()
    (tmp_path / loop.CHECKPOINT).write_bytes({"empty": b"", "half": content[: len(content) // 2]}.get(damage, content))
    if damage == "no tensor":
        tensors = {name: value for name, value in load_file(whole).items() if name != "generator"}
        with safe_open(whole, framework="pt") as file:
            save_file(tensors, tmp_path / loop.CHECKPOINT, metadata=file.metadata())
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        train(small_settings("lstm-gmm", data, tmp_path, resume=True))


@pytest.mark.parametrize("name", list_params(NETWORKS))
def test_a_run_that_diverges_stops_and_keeps_its_last_checkpoint(name, data, tmp_path, monkeypatch):
    make = load_recipe(name).make_trainer

    def make_broken(settings, parts):
        trainer = make(settings, parts)
        taken = trainer.losses

        def losses():
            found = taken()
            return found | {"loss": found["loss"] * (math.nan if trainer.step == 3 else 1.0)}

        trainer.losses = losses
        return trainer

    monkeypatch.setattr(load_recipe(name), "make_trainer", make_broken)
    with pytest.raises(MapctlError, match="diverged at step 4"):
        train(small_settings(name, data, tmp_path / "run", checkpoint_minutes=0.0))
    assert read_step(tmp_path / "run") == 3
    assert not (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.parametrize(("patience", "last", "best"), [(0, 6, 6), (1, 4, 2), (2, 6, 2)])
def test_training_ends_where_validation_no_longer_improves_with_the_best_weights(
    patience, last, best, data, tmp_path, monkeypatch
):
    scores, seen, make = {0: 9.0, 2: 3.0, 4: 5.0, 6: 4.0}, {}, load_recipe("path").make_trainer

    def make_scripted(settings, parts):
        trainer = make(settings, parts)

        def validate(corpus):
            seen[trainer.step] = {key: value.clone() for key, value in trainer.network.state_dict().items()}
            return {"loss": scores[trainer.step]}

        trainer.validate = validate
        return trainer

    monkeypatch.setattr(load_recipe("path"), "make_trainer", make_scripted)
    train(small_settings("path", data, tmp_path / "run", patience=patience))
    card = checkpoints.read_card(tmp_path / "run" / "model.json")
    assert card.training["curve"][-1]["step"] == last
    assert ("ended" in card.training) == (patience > 0)
    found = load_file(tmp_path / "run" / "model.safetensors")
    kept = {key: value.half().float() for key, value in seen[best].items() if key not in ("mean", "std")}
    assert all(torch.equal(found[key].float(), value) for key, value in kept.items())


@pytest.mark.parametrize("name", list_params(NETWORKS))
def test_a_run_may_begin_with_the_weights_of_another_and_keep_a_share_of_them(name, finished, data, tmp_path):
    before = finished(name)
    settings = small_settings(name, data, tmp_path / "run", steps=1, shape=None, init=str(before), init_share=0.999)
    assert settings.split_seed == 1
    train(settings)
    card = checkpoints.read_card(tmp_path / "run" / "model.json")
    assert card.data["init"]["name"] == before.name
    assert card.config == checkpoints.read_card(before / "model.json").config
    old, new = (load_file(out / "model.safetensors") for out in (before, tmp_path / "run"))
    shared = [key for key in new if key in old and not key.startswith("starts.") and old[key].is_floating_point()]
    assert shared
    assert all((old[key].float() - new[key].float()).abs().max() < 0.05 for key in shared if "temperature" not in key)


@pytest.mark.parametrize("name", list_params(NETWORKS))
def test_a_step_in_bfloat16_has_the_loss_of_one_in_float32_nearly(name, data, prior, tmp_path):
    parts, losses = small_settings(name, data, tmp_path, prior).gather(), []
    for reduced in (False, True):
        trainer = small_settings(name, data, tmp_path, prior, bfloat16=reduced).make_trainer(parts)
        trainer.train_step()  # heads that begin at zero hide the precision of the first step's loss
        losses.append(trainer.train_step()["loss"])
    assert losses[0] != losses[1]
    assert losses[0] == pytest.approx(losses[1], rel=0.05, abs=0.05)


def test_an_interruption_is_explained_by_the_last_checkpoint(data, tmp_path, monkeypatch, capsys):
    def interrupt(self):
        raise KeyboardInterrupt

    words = ["train", "lstm-gmm", "--data", data, "-o", tmp_path / "run", "--steps", 6, "--batch", 4, "--window", 20]
    words += ["--width", 8]
    with killing(load_recipe("lstm-gmm"), 3):
        train(small_settings("lstm-gmm", data, tmp_path / "run", checkpoint_minutes=0.0, shape=None, width=8))
    monkeypatch.setattr(GradientTrainer, "train_step", interrupt)
    assert run(*words, "--resume") == 130
    assert "step 3 is saved; the same command with --resume goes on" in capsys.readouterr().err
    words[5] = tmp_path / "other"
    assert run(*words) == 130
    assert "nothing was saved yet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words", "check"),
    [
        ("lstm-gmm", "--steps 7 --seed 3 --patience 2 --match walk --level", lambda s: (s.steps, s.level) == (7, True)),
        ("lstm-gmm", "--paper --width 8", lambda s: (s.find_config().width, s.find_config().retain) == (8, 0.0)),
        ("refiner", "--density mine --paper", lambda s: (s.density, s.config.memory) == ("mine", 1000)),
        ("denoiser", "--width 8", lambda s: s.find_config().width == 8),
        ("path", "--batch 6 --window 64", lambda s: (s.batch, s.window) == (6, 64)),
        ("tweener", "--paper --labels (a)", lambda s: (s.find_config().skips, s.labels) == (False, "(a)")),
        ("stitcher", "--init x --device cpu", lambda s: (s.init, s.device) == ("x", "cpu")),
    ],
)
def test_options_are_the_settings(name, words, check):
    assert check(parse(name, *words.split()))


@pytest.mark.parametrize(
    ("name", "words", "reason"),
    [
        ("denoiser", "--steps 0", "steps must be at least 1"),
        ("path", "--seed -1", "the seed must be"),
        ("denoiser", "--window 4", "window must be at least 16"),
        ("lstm-gmm", "--init locomotion --width 8", "with --init the network is that model's"),
        ("lstm-gmm", "--steps 5 --critic-steps 5", "a critic joins the last steps"),
        ("lstm-gmm", "--standing-share 2", "at most 1"),
        ("path", "--starts 3", "[Uu]nrecognized"),
    ],
)
def test_options_that_make_no_sense_are_refused(name, words, reason):
    with pytest.raises(RequestError, match=reason):
        parse(name, *words.split())


def test_a_folder_that_is_none_is_refused_and_nothing_written(tmp_path):
    with pytest.raises(RequestError, match="is not a folder"):
        train(small_settings("path", tmp_path / "nowhere", tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_the_learning_rate_rises_and_falls_to_zero():
    rates = [warmup_cosine(step, 100) for step in range(101)]
    assert rates[:5] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert rates[-1] == pytest.approx(0)
    assert all(one > other for one, other in pairwise(rates[5:]))


def parse(name, *words):
    return cli.parse(["train", name, "--data", "data", "-o", "run", *words])
