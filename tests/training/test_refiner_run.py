"""`mapctl train refiner` on five synthetic clips and a density of a few kilobytes."""

import json
import math
import shutil
from dataclasses import asdict, replace

import pytest
import torch
from helpers import killing, write_corpus
from safetensors.torch import load_file, save_file
from tiny_prior import save_tiny_prior, save_walking_density

import priors
from mapctl import cli
from mapctl.commands.train.options import TrainOptions
from mapctl.errors import CheckpointError, RequestError
from mapctl.metrics.realism import ClassifierSettings, RealismSettings
from priors.refiner.network import RefinerConfig
from priors.training import corpus as corpora
from priors.training.quality.refiner import RefinerEvaluator, compute_realism_gap, sample_corpus
from priors.training.recipes.refiner import PAPER, AdversarialSettings, AdversarialTrainer, RefinerRecipe
from priors.training.run import train

TINY = RefinerConfig(width=6, memory=5, lookahead=1, joints=("hips", "rightToes"))
SETTINGS = AdversarialSettings(
    rounds=6, window=10, batch=4, warm_up=1, head_start=1, critic_updates=1, history=8, critic_width=6, critic_around=1
)


@pytest.fixture(scope="module")
def density(tmp_path_factory):
    return str(save_walking_density(tmp_path_factory.mktemp("density") / "walks.safetensors"))


@pytest.fixture
def request_in(data, density):
    """Checkpoints in every round, so that a kill can come anywhere; news and measures rarely."""

    def made(out, **changes):
        settings = replace(SETTINGS, **changes.pop("settings", {}))
        given = {
            "checkpoint_minutes": 0.0,
            "report_steps": 2,
            "validate_steps": 4,
            "samples": 6,
            "judged": 2,
            "seconds": 1.2,
            "density": density,
            "config": TINY,
        } | changes
        return RefinerRecipe(data, out, settings=settings, **given)

    return made


def killed_in(request, number):
    """Runs until a round is begun."""
    with killing(AdversarialTrainer, number):
        train(request)


def test_killed_and_resumed_is_the_uninterrupted_run_to_the_bit(tmp_path, request_in):
    """Killed between two lines of news, and just after one."""
    whole = train(request_in(tmp_path / "whole"))
    killed_in(request_in(tmp_path / "parts"), 3)
    killed_in(request_in(tmp_path / "parts", resume=True), 4)
    parts = train(request_in(tmp_path / "parts", resume=True))
    for name in (whole.name, "model.json", "step-6-checkpoint.safetensors", "checkpoint.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert parts == tmp_path / "parts" / "model.safetensors"


@pytest.mark.slow
def test_a_finished_run_loads_with_a_complete_card_and_only_its_files(tmp_path, request_in, density):
    news, out = [], tmp_path / "run"
    path = train(request_in(out, licence="CC0"), news.append)
    refiner = priors.load_refiner(str(out))
    card = refiner.card
    assert (card.kind, card.licence, refiner.network.config) == ("refiner", "CC0", TINY)
    assert card.data["density"] == density
    assert card.data["density_config"] == priors.load(density).reference.config.as_card()
    assert (card.data["clips"], card.data["frames"], card.data["samples"]) == ("5", "400", 6)
    assert card.data["match"] == "walk"  # the density's
    assert card.training["settings"] == asdict(SETTINGS)
    assert [row["round"] for row in card.training["curve"]] == [0, 4, 6]
    for row in card.training["curve"]:
        assert {"jitter_m_s3_ratio", "score"} <= set(row)
        assert row["round"] == 0 or row["training_critic"] > 0
    assert card.quality["round"] == min(card.training["curve"], key=compute_realism_gap)["round"]
    assert set(card.quality["test"]) == {"contact_speed_cm_s_ratio", "jitter_m_s3_ratio"}
    assert f"--density {density}" in card.training["command"]
    assert [line.split(":")[0] for line in news if line.startswith("round")] == ["round 2/6", "round 4/6", "round 6/6"]
    files = {file.name for file in out.iterdir()}
    assert files == {"cache", "checkpoint.json", "step-6-checkpoint.safetensors", "losses.csv", "model.json", path.name}


@pytest.mark.parametrize(
    ("variant", "changes"),
    [
        ((RefinerConfig(), AdversarialSettings()), {"rounds": 7, "bfloat16": True, "seed": 3}),
        (PAPER, {"batch": 12, "window": 20}),
    ],
    ids=["ours", "paper"],
)
def test_the_command_of_a_card_asks_for_the_same_run(tmp_path, data, variant, changes):
    """What is typed from the card, the command line reads as the request that wrote it."""
    config, recipe = variant
    wanted = RefinerRecipe(data, tmp_path, match="walk-[01]", config=config, settings=replace(recipe, **changes))
    words = wanted.format_command().replace("'", "").replace("DATA", str(data)).replace("RUN", str(tmp_path)).split()
    given = cli.parse(words[1:])
    assert isinstance(given, TrainOptions)
    assert given.recipe() == wanted


def test_samples_go_on_from_the_clips_they_are_drawn_with(data, density, tmp_path):
    prior = priors.load(density)
    clips = corpora.read_corpus(data, match="", cache=tmp_path)
    drawn = [sample_corpus(prior, clips, 4, 20, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert drawn[0].lengths == (20,) * 4
    assert drawn[0].features.shape == (80, clips.features.shape[1])
    assert torch.equal(drawn[0].features, drawn[1].features)
    assert not torch.equal(drawn[0].features, drawn[2].features)
    short = corpora.Corpus(("a", "b"), (59, 60), clips.features[:119])
    assert sample_corpus(prior, short, 3, 5, torch.Generator()).lengths == (5,) * 3  # all after the longer


@pytest.fixture
def scripted(monkeypatch):
    """Rounds that mark a bias with their number and tell the losses given; the measures are given round by round."""

    def play(losses, scores):
        step = AdversarialTrainer.train_step

        def train_step(trainer):
            step(trainer)
            with torch.no_grad():
                trainer.network.last.bias.fill_(trainer.step)
            return losses(trainer.step)

        def judged(judge, network):
            return {"jitter_m_s3_ratio": scores.get(round(network.last.bias[0].item()), 9.0)}

        monkeypatch.setattr(AdversarialTrainer, "train_step", train_step)
        monkeypatch.setattr(RefinerEvaluator, "__call__", judged)

    return play


def even(number):
    return {"refiner": 0.7, "critic": 0.69, "told": 0.5, "updates": 1}


def kept(path):
    """Which round's refiner was exported."""
    return int(load_file(path)["last.bias"][0])


@pytest.mark.slow
def test_the_best_refiner_seen_is_exported(tmp_path, request_in, scripted):
    scripted(even, {0: 2.0, 2: 1.5, 4: 1.1, 6: 0.5})
    path = train(request_in(tmp_path / "run", validate_steps=2))
    assert kept(path) == 4
    card = priors.load_refiner(str(path)).card
    assert card.quality == {"round": 4, "test": {"jitter_m_s3_ratio": 1.1}}


def test_a_refiner_is_chosen_by_other_clips_than_it_is_measured_on(tmp_path, request_in, scripted, monkeypatch):
    """By the measures of a card no refiner was chosen."""
    scripted(even, dict.fromkeys(range(7), 1.0))
    shown, make_judge = [], RefinerEvaluator.of

    def note(raw, held, settings):
        shown.append(held.names)
        return make_judge(raw, held, settings)

    monkeypatch.setattr(RefinerEvaluator, "of", note)
    train(request_in(tmp_path / "run"))
    (chosen_by,), (measured_on,) = shown
    assert chosen_by != measured_on


@pytest.mark.slow
@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_a_measure_that_cannot_be_had_is_never_the_best_and_null_in_the_card(tmp_path, request_in, scripted, bad):
    scripted(even, {0: 2.0, 2: bad, 4: bad, 6: bad})
    path = train(request_in(tmp_path / "run", validate_steps=2))
    assert kept(path) == 0
    curve = priors.load_refiner(str(path)).card.training["curve"]
    assert [row["score"] for row in curve] == [pytest.approx(math.log(2)), None, None, None]
    for file in (tmp_path / "run").glob("*.json"):
        json.loads(file.read_text(), parse_constant=pytest.fail)


@pytest.mark.slow
def test_it_stops_with_the_best_when_the_critic_has_won(tmp_path, request_in, scripted):
    """And a resumed run stops there too, though it was killed within the report that decides."""
    news = []
    scripted(lambda number: even(number) | {"told": 1.0 if number > 4 else 0.5}, {0: 2.0, 4: 1.2, 8: 1.0})
    request = request_in(tmp_path / "run", settings={"rounds": 20})
    assert kept(train(request, news.append)) == 4
    assert news[-1] == "the critic has won: training ends with the best refiner seen"
    assert news[-2].startswith("round 6/20:")
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 5
    again = []
    assert kept(train(replace(request, resume=True), again.append)) == 4
    assert "resumed at round 5" in again
    assert again[-1] == news[-1]


@pytest.mark.slow
def test_one_report_that_is_nearly_won_does_not_stop_it(tmp_path, request_in, scripted):
    scripted(lambda number: even(number) | {"told": 0.97}, {6: 1.0})
    assert kept(train(request_in(tmp_path / "run"))) == 6


@pytest.mark.slow
@pytest.mark.parametrize("side", ["refiner", "critic"])
def test_it_stops_with_the_best_when_it_diverges(tmp_path, request_in, scripted, side):
    news, marked = [], {0: 2.0, 4: 1.2, 6: 1.0}
    scripted(lambda number: even(number) | ({side: math.nan} if number == 5 else {}), marked)
    assert kept(train(request_in(tmp_path / "run"), news.append)) == 4
    assert news[-1] == "training diverged at round 5: training ends with the best refiner seen"
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 4


@pytest.mark.slow
def test_weights_that_are_not_finite_are_seen(tmp_path, request_in, monkeypatch):
    step = AdversarialTrainer.train_step

    def spoiled(trainer):
        if trainer.step == 2:
            trainer.refiner.last.bias.data[0] = torch.nan
        return step(trainer)

    monkeypatch.setattr(AdversarialTrainer, "train_step", spoiled)
    news = []
    path = train(request_in(tmp_path / "run"), news.append)
    assert news[-1].startswith("training diverged at round 3")
    assert all(bool(value.isfinite().all()) for value in load_file(path).values())


def test_scores_are_distances_from_mocap():
    assert compute_realism_gap({"a_ratio": 1.0, "b_ratio": 1.0, "told_apart": 0.4, "round": 7}) == 0
    assert compute_realism_gap({"a_ratio": 2.0}) == compute_realism_gap({"a_ratio": 0.5}) == pytest.approx(math.log(2))
    assert compute_realism_gap({"a_ratio": 1.0, "told_apart": 0.8}) == pytest.approx(0.6)
    assert compute_realism_gap({"a_ratio": None}) == math.inf


@pytest.mark.slow
def test_the_judge_measures_against_clips_kept_from_training(data, density, tmp_path):
    clips = corpora.read_corpus(data, match="", cache=tmp_path)
    parts = corpora.split_corpus(clips, 1)
    raw = corpora.Corpus(("a", "b"), (80, 80), parts.validation.features.repeat(2, 1))
    quick = RealismSettings(classifier=ClassifierSettings(folds=2, steps=5, width=4, batch=8), dims=2)
    trainer = AdversarialTrainer(TINY, SETTINGS, parts.train, raw)
    row = RefinerEvaluator.of(raw, parts.validation, quick)(trainer.refiner)
    assert row["jitter_m_s3_ratio"] == pytest.approx(1, abs=1e-3)  # the very same clips
    assert row["contact_speed_cm_s_ratio"] == pytest.approx(1, abs=1e-3)
    assert "told_apart" not in row  # two clips are too few
    made = corpora.Corpus(tuple("abcd"), (80,) * 4, parts.validation.features.repeat(4, 1))
    judge = RefinerEvaluator.of(made, clips, quick)
    first, again = judge(trainer.refiner), judge(trainer.refiner)
    assert 0 <= first["told_apart"] <= 1
    assert first == again


@pytest.mark.slow
def test_resuming_is_asked_for_and_needs_the_same_recipe_network_and_data(tmp_path, data, request_in):
    out = tmp_path / "run"
    with pytest.raises(CheckpointError, match="no checkpoint to resume"):
        train(request_in(out, resume=True))
    killed_in(request_in(out), 2)
    with pytest.raises(RequestError, match="already holds a run; pass --resume"):
        train(request_in(out))
    with pytest.raises(CheckpointError, match=r"other settings \(root: 20\.0 then, 3\.0 now\)"):
        train(request_in(out, resume=True, settings={"root": 3.0}))
    with pytest.raises(CheckpointError, match=r"other network \(width: 6 then, 7 now\)"):
        train(request_in(out, resume=True, config=replace(TINY, width=7)))
    with pytest.raises(CheckpointError, match=r"other data \(match: walk then, walk-\. now\)"):
        train(request_in(out, resume=True, match="walk-."))
    more = write_corpus(tmp_path / "more", count=6)
    with pytest.raises(CheckpointError, match=r"other data .*clips: 5 then, 6 now"):
        train(replace(request_in(out, resume=True), data=more))
    other = save_tiny_prior(tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match=r"other data .*density: .* then, .*other\.safetensors now"):
        train(request_in(out, resume=True, density=str(other), match="walk"))


@pytest.fixture(scope="module")
def begun(tmp_path_factory, data, density):
    """The folder of a run of one round."""
    out = tmp_path_factory.mktemp("begun") / "run"
    settings = replace(SETTINGS, rounds=1)
    train(RefinerRecipe(data, out, density=density, config=TINY, settings=settings, samples=3, judged=1, seconds=1.2))
    return out


@pytest.mark.parametrize(
    "change",
    [
        {"curve": [3]},
        {"curve": None},
        {"losses": [{"told": 1}]},
        {"losses": None},
        {"settings": []},
        {"network": None},
        {"data": 3},
        {"tensors": "gone"},
    ],
)
def test_broken_checkpoints_are_refused(tmp_path, request_in, begun, change):
    out = shutil.copytree(begun, tmp_path / "run")
    index = json.loads((out / "checkpoint.json").read_text())
    (out / "checkpoint.json").write_text(json.dumps(index | change))
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        train(request_in(out, resume=True, settings={"rounds": 1}))


@pytest.mark.parametrize("drop", ["best.last.bias", "counts", "history", "critic-optimiser.0.exp_avg"])
def test_a_checkpoint_without_a_tensor_is_refused(tmp_path, request_in, begun, drop):
    out = shutil.copytree(begun, tmp_path / "run")
    (file,) = out.glob("step-*")
    tensors = load_file(file)
    del tensors[drop]
    save_file(tensors, file)
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        train(request_in(out, resume=True, settings={"rounds": 1}))


def test_what_cannot_be_trained_on_is_refused_before_anything_is_written(tmp_path, request_in):
    with pytest.raises(RequestError, match="not a folder of BVH"):
        train(replace(request_in(tmp_path / "run"), data=tmp_path / "nowhere"))
    with pytest.raises(CheckpointError, match="no prior 'nobody'"):
        train(request_in(tmp_path / "run", density="nobody"))
    with pytest.raises(RequestError, match=r"no .bvh below .* matches 'dance'"):
        train(request_in(tmp_path / "run", match="dance"))
    with pytest.raises(RequestError, match="75 to hold out in the longest clip; got clips of 80"):
        train(request_in(tmp_path / "run", match="walk-0"))
    with pytest.raises(RequestError, match="no clip is as long as the window of 43 frames"):
        train(request_in(tmp_path / "run", settings={"window": 40}))
    assert not (tmp_path / "run" / "checkpoint.json").exists()


@pytest.mark.slow
def test_two_clips_are_enough_and_a_third_that_is_none_is_left_out(tmp_path, request_in):
    folder = write_corpus(tmp_path / "two", count=2, frames=100)
    (folder / "walk-broken.bvh").write_text("HIERARCHY")
    request, warnings = replace(request_in(tmp_path / "run"), data=folder), []
    card = priors.load_refiner(str(train(request, warn=warnings.append))).card
    assert set(card.data["skipped"]) == {"walk-broken.bvh"}
    assert warnings[0].startswith(f"left out 1 of 3 files: {folder / 'walk-broken.bvh'}: ")
    with pytest.raises(RequestError, match=r"--strict-data: .*walk-broken\.bvh: "):
        train(replace(request, out=tmp_path / "strict", strict_data=True))


def test_a_refiner_is_no_density_to_refine(tmp_path, request_in, begun):
    with pytest.raises(CheckpointError, match="a refiner is no density"):
        train(request_in(tmp_path / "run", density=str(begun)))
