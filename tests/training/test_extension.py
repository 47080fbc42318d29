"""Runs that are extended beyond their end, or cut short: `--resume --steps MORE`."""

import json
from dataclasses import replace

import pytest
from ended_models import MODELS
from helpers import corpus, killing
from helpers import run as mapctl_run
from tiny_infiller import CONFIG as INFILLER
from tiny_stitcher import CONFIG as STITCHER

from mapctl.errors import RequestError
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training.recipes import lstm_gmm
from priors.training.recipes.infiller import InfillerRecipe, InfillerSettings, InfillerTrainer
from priors.training.recipes.stitcher import StitcherSettings, StitcherTrainer
from priors.training.run import train

pytestmark = pytest.mark.usefixtures("small_judgements")


def with_steps(recipe, steps, **changes):
    return replace(recipe, settings=replace(recipe.settings, **{recipe.steps_name: steps}), **changes)


def paper(data, out):
    """The paper's recipe, whose learning rate falls with each pass over the data."""
    settings = replace(lstm_gmm.PAPER[1], steps=4, batch=4, window=20)
    config = replace(lstm_gmm.PAPER[0], width=8, components=2)
    return lstm_gmm.DensityRecipe(
        data, out, config=config, settings=settings, device="cpu", validate_steps=2, report_steps=3, starts=4
    )


@pytest.mark.slow
def test_where_the_schedule_does_not_go_by_the_total_an_extended_run_is_the_longer_run_to_the_bit(tmp_path, data):
    train(paper(data, tmp_path / "parts"))
    train(with_steps(paper(data, tmp_path / "parts"), 8, resume=True))
    train(with_steps(paper(data, tmp_path / "whole"), 8))
    for name in ("model.safetensors", "step-8-checkpoint.safetensors"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    cards = [json.loads((tmp_path / run / "model.json").read_text()) for run in ("parts", "whole")]
    assert cards[0]["training"].pop("extended") == [{"at": 4, "from": 4, "to": 8}]
    assert cards[0] == cards[1]
    rows = [(tmp_path / run / "losses.csv").read_text().splitlines() for run in ("parts", "whole")]
    assert [row for row in rows[0] if not row.startswith("4,training")] == rows[1]  # a report at the first end


@pytest.mark.slow
def test_the_refiner_goes_on_to_the_bit_too(tmp_path, data, prior):
    made = MODELS["refiner"].recipe(data, tmp_path / "parts", prior)
    train(with_steps(made, 4))
    train(with_steps(made, 6, resume=True))
    train(replace(made, out=tmp_path / "whole"))
    assert (tmp_path / "parts" / "model.safetensors").read_bytes() == (
        tmp_path / "whole" / "model.safetensors"
    ).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["infiller", "keyframe-timing"])
def test_a_finished_run_is_extended_twice_and_killed_in_between(name, tmp_path, data, prior):
    model = MODELS[name]
    made = replace(model.recipe(data, tmp_path / "run", prior), checkpoint_minutes=0.0)
    train(made)
    with killing(model.trainer, 7):
        train(with_steps(made, 8, resume=True))
    train(with_steps(made, 8, resume=True))
    path = train(with_steps(made, 9, resume=True))
    training = json.loads(path.with_suffix(".json").read_text())["training"]
    assert [row["step"] for row in training["curve"]][-3:] == [6, 8, 9]
    assert training["extended"] == [{"at": 6, "from": 6, "to": 8}, {"at": 8, "from": 8, "to": 9}]
    assert training["settings"]["steps"] == 9
    assert "--steps 9" in training["command"]
    index = json.loads((tmp_path / "run" / "checkpoint.json").read_text())
    assert (index["step"], index["steps"], index["first_steps"]) == (9, 9, 6)


def test_the_learning_rate_follows_the_new_total_and_what_has_grown_stays_grown():
    settings = InfillerSettings(steps=200, batch=2, window=40)
    trainer = InfillerTrainer(INFILLER, settings, corpus(2, 60))
    trainer.step, trainer.steps = 100, 200
    trainer.set_first_steps(100)
    longer = InfillerTrainer(INFILLER, settings, corpus(2, 60))
    longer.step = 100
    assert trainer.compute_learning_rate() == longer.compute_learning_rate() == pytest.approx(0.5e-3, rel=0.1)
    stitcher = StitcherTrainer(STITCHER, StitcherSettings(steps=200, batch=2, window=32), corpus(2, 60))
    stitcher.step = 100
    assert stitcher._criticised < 0
    stitcher.set_first_steps(100)
    assert stitcher._criticised == 30


def test_free_runs_that_are_never_compared_stay_so():
    settings = replace(lstm_gmm.PAPER[1], steps=8, batch=4, window=20)
    trainer = lstm_gmm.DensityTrainer(LstmGmmConfig(width=8, components=2), settings, corpus(2, 60))
    trainer.set_first_steps(2)
    trainer.step = 4
    trainer._add_moment_gradient = None
    trainer.train_step()


def wanted(data, out, steps, **changes):
    settings = InfillerSettings(steps=steps, batch=2, window=32)
    return InfillerRecipe(data, out, config=INFILLER, settings=settings, checkpoint_minutes=0.0, **changes)


@pytest.mark.slow
def test_fewer_steps_than_are_done_are_refused_and_fewer_than_were_planned_are_not(tmp_path, data):
    with killing(InfillerTrainer, 4):
        train(wanted(data, tmp_path / "run", 6))
    before = (tmp_path / "run" / "checkpoint.json").read_bytes()
    with pytest.raises(RequestError, match="4 steps are done; --steps must be at least that, got 3"):
        train(wanted(data, tmp_path / "run", 3, resume=True))
    assert (tmp_path / "run" / "checkpoint.json").read_bytes() == before
    train(wanted(data, tmp_path / "run", 5, resume=True))
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 5


@pytest.mark.slow
def test_a_checkpoint_of_an_older_version_is_resumed_and_extended(tmp_path, data):
    """It names the steps among the settings, and keeps no losses."""
    train(wanted(data, tmp_path / "run", 4))
    file = tmp_path / "run" / "checkpoint.json"
    index = json.loads(file.read_text())
    index["settings"]["steps"] = 4
    file.write_text(json.dumps({name: index[name] for name in index if name in OLD}))
    (tmp_path / "run" / "losses.csv").unlink()
    train(wanted(data, tmp_path / "run", 6, resume=True))
    index = json.loads(file.read_text())
    assert index["extended"] == [{"at": 4, "from": 4, "to": 6}]
    parts = [line.split(",")[:2] for line in (tmp_path / "run" / "losses.csv").read_text().splitlines()[1:]]
    assert parts == [["4", "validation"], ["6", "training"], ["6", "validation"]]


OLD = ("tensors", "step", "settings", "network", "data", "init", "curve")


@pytest.mark.slow
def test_the_command_extends_and_without_steps_keeps_them(tmp_path, data, capsys):
    words = ("train", "path", "--data", data, "-o", tmp_path / "run", "--batch", 64, "--window", 32)
    assert mapctl_run(*words, "--steps", 2) == 0
    assert mapctl_run(*words, "--resume", "--steps", 3) == 0
    assert "3 steps in all instead of 2" in capsys.readouterr().out
    assert mapctl_run(*words, "--resume") == 0
    assert "instead of" not in capsys.readouterr().out
    assert mapctl_run(*words, "--resume", "--steps", 1) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert json.loads((tmp_path / "run" / "model.json").read_text())["training"]["settings"]["steps"] == 3
