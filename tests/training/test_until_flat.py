"""Runs that go on until their curve is flat: what they are to the bit, resumed, in two processes, by their cards."""

import json
import math
import shlex
from dataclasses import asdict, replace
from functools import partial
from itertools import pairwise

import pytest
import tiny_path
from ended_models import MODELS, list_params
from helpers import Killed, killing
from helpers import run as mapctl_run

import priors
from mapctl import cli
from mapctl.commands.train.options import TrainOptions
from mapctl.errors import CheckpointError, RequestError
from priors.training import run
from priors.training.ending.course import Course, UntilFlat
from priors.training.ending.decay import Decay
from priors.training.quality import density as density_quality
from priors.training.recipes.density.trainer import DensityTrainer
from priors.training.recipes.path import PathRecipe, PathSettings, PathTrainer
from priors.training.recipes.stitcher import StitcherConfig, StitcherRecipe
from priors.training.run import train

SETTINGS = PathSettings(steps=24, batch=64, window=32)
FILES = ("model.safetensors", "model.json", "losses.csv", "checkpoint.json")


@pytest.fixture(autouse=True)
def made_up_curve(monkeypatch):
    """Validations that settle after a fifth of the plan, whatever is learnt: what ends a run is then known."""
    monkeypatch.setattr(PathTrainer, "validate", lambda self, corpus: {"all_V1_cm": 1 + 9 * math.exp(-self.step / 3)})
    whole = density_quality.measure_free_runs
    monkeypatch.setattr(density_quality, "measure_free_runs", partial(whole, runs=2, frames=20))


def wanted(data, out, **changes):
    rule = UntilFlat(**changes.pop("rule", {}))
    given = {"checkpoint_minutes": 0.0, "report_steps": 4} | changes
    return PathRecipe(data, out, config=tiny_path.CONFIG, settings=SETTINGS, until_flat=rule, **given)


def read_training(out):
    return json.loads((out / "model.json").read_text())["training"]


def test_it_ends_where_the_curve_is_flat_and_the_card_says_when_and_why(tmp_path, data):
    news = []
    train(wanted(data, tmp_path / "run"), news.append)
    training = read_training(tmp_path / "run")
    ended, begin = training["ended"], training["ended"]["decay_from"]
    assert 18 <= begin <= 32
    assert ended["steps"] == begin + round(begin / 4)
    assert [row["step"] for row in training["curve"]] == list(range(1, ended["steps"] + 1))
    assert ended["reason"].startswith("the curve was flat: at most ")
    assert ended["reason"].endswith(f"better over the last third of {begin} steps")
    assert "minutes" not in ended
    shape = "--width 4 --steps 24 --batch 64 --window 32"
    assert training["command"] == f"mapctl train path --data DATA -o RUN {shape} --until-flat"
    assert training["settings"]["steps"] == 24
    assert f"{ended['reason']}: training ends at step {ended['steps']}" in news
    told = [line.split(":")[0] for line in news if line.startswith("step ")]
    assert (told[0], told[-1]) == ("step 4/72", f"step {ended['steps']}/{ended['steps']}")
    assert priors.load_path(str(tmp_path / "run")).network.config == tiny_path.CONFIG


@pytest.mark.slow
def test_killed_anywhere_and_resumed_it_is_the_uninterrupted_run_to_the_bit(tmp_path, data):
    train(wanted(data, tmp_path / "whole"))
    begin = read_training(tmp_path / "whole")["ended"]["decay_from"]
    for step in (3, begin, begin + 2):
        with killing(PathTrainer, step):
            train(wanted(data, tmp_path / "parts", resume=step > 3))
    train(wanted(data, tmp_path / "parts", resume=True))
    for name in FILES:
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    before = (tmp_path / "whole" / "model.safetensors").read_bytes()
    train(wanted(data, tmp_path / "whole", resume=True))
    assert (tmp_path / "whole" / "model.safetensors").read_bytes() == before


@pytest.mark.slow
def test_two_processes_end_at_the_same_step_to_the_bit_also_resumed(tmp_path, data):
    train(wanted(data, tmp_path / "whole", processes=2))
    begin = read_training(tmp_path / "whole")["ended"]["decay_from"]
    with killing(PathTrainer, begin + 1):
        train(wanted(data, tmp_path / "parts", processes=2))
    train(wanted(data, tmp_path / "parts", processes=2, resume=True))
    for name in FILES:
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name


@pytest.mark.slow
def test_the_learning_rate_stays_until_the_decay_and_then_falls(tmp_path, data, monkeypatch):
    rates, step = [], PathTrainer.train_step

    def noting(self):
        rates.append(self.compute_learning_rate() / self.learning_rate)
        return step(self)

    monkeypatch.setattr(PathTrainer, "train_step", noting)
    train(wanted(data, tmp_path / "run"))
    begin = read_training(tmp_path / "run")["ended"]["decay_from"]
    assert rates[1:begin] == [1.0] * (begin - 1)
    assert all(after < before for before, after in pairwise(rates[begin - 1 :]))
    assert 0 < rates[-1] < 0.1


@pytest.mark.slow
def test_what_a_clock_has_decided_the_card_tells_so_that_any_run_is_the_same_to_the_bit(tmp_path, data, monkeypatch):
    """Also where it is killed after the decision: that is saved at once."""
    seconds = iter(range(10_000))
    monkeypatch.setattr(run, "Course", partial(Course, clock=lambda: next(seconds)))
    recipe = wanted(data, tmp_path / "limited", minutes=0.5, checkpoint_minutes=100.0)
    step = PathTrainer.train_step

    def killed_in_its_decay(self):
        if self.decay is not None and self.step == self.decay.begin:
            raise Killed
        return step(self)

    with monkeypatch.context() as patch:
        patch.setattr(PathTrainer, "train_step", killed_in_its_decay)
        with pytest.raises(Killed):
            train(recipe)
    index = json.loads((tmp_path / "limited" / "checkpoint.json").read_text())
    found = Decay(**index["end"]["decay"])
    assert index["step"] == found.begin
    train(replace(recipe, resume=True))
    training = read_training(tmp_path / "limited")
    assert training["ended"]["reason"] == "0.5 minutes were nearly up"
    assert training["ended"]["minutes"] > 0
    assert training["command"].endswith(f"--until-flat --decay-from {found}")
    monkeypatch.undo()
    monkeypatch.setattr(PathTrainer, "validate", lambda self, corpus: {"all_V1_cm": 1.0})
    words = training["command"].replace("DATA", str(data)).replace("RUN", str(tmp_path / "typed"))
    assert mapctl_run(*shlex.split(words)[1:]) == 0
    assert (tmp_path / "typed" / "model.safetensors").read_bytes() == (
        tmp_path / "limited" / "model.safetensors"
    ).read_bytes()


def test_the_command_of_a_card_asks_for_the_same_run(tmp_path, data):
    for rule in ({}, {"share": 0.005}, {"decay_from": Decay(9, 3), "share": 0.01}):
        recipe = replace(wanted(data, tmp_path, rule=rule, split=7), checkpoint_minutes=3.0, report_steps=100)
        words = shlex.split(recipe.format_command().replace("DATA", str(data)).replace("RUN", str(tmp_path)))
        given = cli.parse(words[1:])
        assert isinstance(given, TrainOptions)
        assert given.recipe() == recipe
        assert cli.parse(given.format_command()[1:]) == given


@pytest.mark.slow
def test_a_density_compares_free_runs_in_its_decay_and_no_sooner(data, tmp_path, monkeypatch):
    compared = []
    monkeypatch.setattr(DensityTrainer, "_add_moment_gradient", lambda self, windows: compared.append(self.step))
    rule = UntilFlat(decay_from=Decay(9, 8))
    train(replace(MODELS["lstm-gmm"].recipe(data, tmp_path / "run", ""), until_flat=rule))
    assert compared == [12, 16]
    assert "--until-flat --decay-from 9:8" in read_training(tmp_path / "run")["command"]


NETWORKS = [name for name in MODELS if name not in ("refiner", "keyframe-timing")]


@pytest.mark.slow
@pytest.mark.parametrize("name", list_params(NETWORKS))
def test_every_network_can_be_trained_so(name, tmp_path, data, prior):
    recipe = MODELS[name].recipe(data, tmp_path / "run", prior)
    train(replace(recipe, until_flat=UntilFlat(decay_from=Decay(2, 2))))
    training = read_training(tmp_path / "run")
    curve = training["curve"]
    assert [row["step"] for row in curve] == [1, 2, 3, 4]
    if name not in ("path", "tweener"):  # the walks are too short for a tweener's gaps
        assert [step for step, _ in recipe.find_points(curve)] == [1, 2, 3, 4]
    card = json.loads((tmp_path / "run" / "model.json").read_text())
    assert name in ("path", "tweener") or math.isfinite(recipe.find_card_headline(card["quality"]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["refiner", "keyframe-timing"])
def test_others_end_at_once_when_their_minutes_are_up(name, tmp_path, data, prior):
    recipe = replace(MODELS[name].recipe(data, tmp_path / "run", prior), minutes=1e-9)
    train(recipe)
    training = read_training(tmp_path / "run")
    assert training["ended"].pop("minutes") < 1
    assert training["ended"] == {"steps": 1, "decay_from": 1, "reason": "1e-09 minutes were nearly up"}
    assert training["settings"][recipe.steps_name] == 1
    assert "--steps 1" in training["command"]
    assert training["curve"][-1][recipe.counter] == 1


@pytest.mark.slow
def test_what_cannot_go_together_is_refused(tmp_path, data):
    out = tmp_path / "run"
    with killing(PathTrainer, 4):
        train(wanted(data, out))
    plain = replace(wanted(data, out, resume=True), until_flat=None)
    with pytest.raises(CheckpointError, match=r"was begun with --until-flat .* go on with a length of its own"):
        train(plain)
    with pytest.raises(RequestError, match="keeps its --steps 24"):
        train(replace(wanted(data, out, resume=True), settings=replace(SETTINGS, steps=30)))
    with pytest.raises(CheckpointError, match=r"other data \(split seed: None then, 5 now\)"):
        train(wanted(data, out, resume=True, split=5))
    with pytest.raises(RequestError, match=r"minutes limit a path only until its curve is flat \(--until-flat\)"):
        train(replace(plain, out=tmp_path / "other", resume=False, minutes=5.0))
    with killing(PathTrainer, 2):
        train(replace(plain, out=tmp_path / "plain", resume=False))
    with pytest.raises(CheckpointError, match="begun with a length of its own"):
        train(wanted(data, tmp_path / "plain", resume=True))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("path", "--decay-from", "8:2"), "--flat-share and --decay-from are for --until-flat"),
        (("path", "--flat-share", "0.1"), "are for --until-flat"),
        (("path", "--until-flat", "--flat-share", "0"), "--flat-share must lie between 0 and 1, got 0"),
        (("path", "--until-flat", "--decay-from", "half"), "--decay-from is STEP:STEPS, as 8000:2000, got 'half'"),
        (("path", "--until-flat", "--decay-from", "8"), "STEP:STEPS"),
        (("path", "--until-flat", "--decay-from", "0:4"), "both at least 1, got 0:4"),
        (("path", "--until-flat", "--minutes", "0"), "--minutes must be positive, got 0"),
        (("path", "--minutes", "5"), "(--until-flat)"),
        (("path", "--split-seed", "-1"), "the seed must be"),
        (("lstm-gmm", "--until-flat", "--paper"), "--paper has a learning rate and a length of its own"),
        (("tweener", "--until-flat", "--critic-from", "4"), "a critic joins a run of a known length"),
        (("lstm-gmm", "--until-flat", "--critic-steps", "4"), "a critic joins a run of a known length"),
        (("lstm-gmm", "--steps", "8", "--critic-steps", "8"), "8 of them are not under the 8 of all"),
    ],
)
def test_on_the_command_line_in_one_line(fails, data, words, message):
    assert message in fails("train", words[0], "--data", data, "-o", "run", *words[1:])


def test_a_split_of_its_own_seed_keeps_the_same_clips_from_training(tmp_path, data):
    recipes = [MODELS[name].recipe(data, tmp_path, "") for name in ("lstm-gmm", "denoiser", "keyframe-timing")]
    for recipe in recipes:
        other = replace(recipe, settings=replace(recipe.settings, seed=5))
        assert (recipe.split_seed, other.split_seed, replace(other, split=1).split_seed) == (1, 5, 1)
        assert replace(other, split=1).source().seed == 1
        assert "--seed 5 --split-seed 1" in replace(other, split=1).format_command().replace(" --width 8", "")
        assert "split" not in recipe.format_command()


def test_a_stitcher_is_not_flat_before_its_critics_have_joined(tmp_path):
    plain = StitcherRecipe(tmp_path, tmp_path)
    assert plain.least_steps() == 8400 + 200
    assert replace(plain, config=StitcherConfig(without=("d",))).least_steps() == 6000


@pytest.mark.slow
def test_the_settings_of_a_run_of_a_known_length_are_as_before(tmp_path, data):
    """Nothing about an end is in what such a run writes."""
    train(replace(wanted(data, tmp_path / "run"), until_flat=None, settings=replace(SETTINGS, steps=2)))
    training = read_training(tmp_path / "run")
    assert set(training) == {"settings", "curve", "command"}
    assert training["settings"] == json.loads(json.dumps(asdict(replace(SETTINGS, steps=2))))
    index = json.loads((tmp_path / "run" / "checkpoint.json").read_text())
    assert not {"until_flat", "end", "seconds"} & set(index)
