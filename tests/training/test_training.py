"""The training command on five synthetic clips: it learns, resumes to the bit, and leaves a loadable prior."""

import json
import math
import shutil
from dataclasses import asdict, replace
from functools import partial

import pytest
import torch
from helpers import Killed, corpus, walk, write_corpus
from safetensors.torch import load_file, save_file

import priors
from mapctl.errors import CheckpointError, MapctlError, RequestError
from mapctl.features import LAYOUT, encode, mirror_features
from mapctl.metrics.states import summarise_states
from priors.lstm_gmm.network import LstmGmmConfig
from priors.training import corpus as corpora
from priors.training.feature_statistics import compute_feature_statistics
from priors.training.quality import density as density_quality
from priors.training.recipes import lstm_gmm
from priors.training.recipes.density.settings import PAPER, TrainingSettings
from priors.training.recipes.density.trainer import DensityTrainer
from priors.training.recipes.lstm_gmm import DensityRecipe
from priors.training.run import train

TINY = LstmGmmConfig(width=8, components=2)
MEASURE = density_quality.measure_free_runs
SETTINGS = TrainingSettings(steps=6, batch=4, window=20)


def shorten_free_runs(monkeypatch):
    monkeypatch.setattr(density_quality, "measure_free_runs", partial(MEASURE, runs=2, frames=20))


@pytest.fixture(autouse=True)
def short_free_runs(monkeypatch):
    shorten_free_runs(monkeypatch)


def request_in(out, data, **changes):
    """Checkpoints at every step, so that a kill can come anywhere."""
    settings = replace(SETTINGS, **changes.pop("settings", {}))
    return DensityRecipe(
        data,
        out,
        config=TINY,
        settings=settings,
        device="cpu",
        checkpoint_minutes=0.0,
        report_steps=1,
        validate_steps=2,
        starts=4,
        **changes,
    )


def killer(step):
    """Progress that ends the run when a step is reported."""

    def progress(line):
        if line.startswith(f"step {step}/6:"):
            raise Killed

    return progress


def without_cost(card):
    """A card without what depends on the folder it was trained in."""
    return {key: value for key, value in vars(card).items() if key != "training"} | {"curve": card.training["curve"]}


def test_killed_and_resumed_is_the_uninterrupted_run_to_the_bit(tmp_path, data):
    whole = train(request_in(tmp_path / "whole", data))
    for step in (3, 5):
        with pytest.raises(Killed):
            train(request_in(tmp_path / "parts", data, resume=step > 3), killer(step))
    parts = train(request_in(tmp_path / "parts", data, resume=True))
    assert parts.read_bytes() == whole.read_bytes()
    for file in (tmp_path / "whole").glob("step-6-*"):
        assert (tmp_path / "parts" / file.name).read_bytes() == file.read_bytes()
    loaded = [priors.load(str(path)) for path in (parts, whole)]
    assert without_cost(loaded[0].card) == without_cost(loaded[1].card)
    assert [row["step"] for row in loaded[0].card.training["curve"]] == [2, 4, 6]


@pytest.mark.parametrize("recipe", ["ours", "paper"])
def test_steps_lower_the_loss(recipe):
    config, settings = (TINY, SETTINGS) if recipe == "ours" else PAPER
    config, settings = replace(config, width=8), replace(settings, steps=400, batch=8, window=20, learning_rate=5e-3)
    trainer = DensityTrainer(config, settings, corpus())
    losses = [trainer.train_step()["loss"] for _ in range(60)]
    assert sum(losses[-5:]) < sum(losses[:5]) - 10


@pytest.mark.slow
def test_a_finished_run_loads_with_a_complete_card_and_only_its_files(tmp_path, data):
    out, news = tmp_path / "run", []
    path = train(request_in(out, data, licence="CC0", match="walk"), news.append)
    prior = priors.load(str(out))
    card = prior.card
    assert card.licence == "CC0"
    assert (card.kind, card.config) == ("lstm-gmm", TINY.as_card())
    assert (card.data["clips"], card.data["frames"]) == (5, 5 * 80)
    assert card.training["settings"] == asdict(SETTINGS)
    assert "mapctl train lstm-gmm" in card.training["command"]
    assert "--skip-first" not in card.training["command"]
    other = request_in(out, data, skip_first=True, settings={"bfloat16": True})
    assert "--skip-first --bfloat16" in other.format_command()
    held = card.data["held_out"]["validation"] + card.data["held_out"]["test"]
    assert len(held) == 2
    assert not set(held) & set(card.data["starts"])
    assert {"validation_nats", "free_run_speed_ratio", "free_run_finite"} <= set(card.training["curve"][-1])
    assert card.quality["test_nats_per_frame"]
    assert prior.reference_log_density == card.quality["windows"]["p2"] <= card.quality["windows"]["mean"]
    assert 0 < prior.limits.slowest < prior.limits.fastest < 3
    assert any("step 6/6: " in line for line in news)
    files = {file.name for file in out.iterdir()}
    assert files == {"cache", "checkpoint.json", "losses.csv", "step-6-checkpoint.safetensors", "model.json", path.name}


@pytest.mark.slow
def test_resuming_is_asked_for_and_needs_the_same_recipe(tmp_path, data):
    out = tmp_path / "run"
    with pytest.raises(CheckpointError, match="no checkpoint to resume"):
        train(request_in(out, data, resume=True))
    train(request_in(out, data))
    with pytest.raises(RequestError, match="already holds a run; pass --resume"):
        train(request_in(out, data))
    with pytest.raises(CheckpointError, match=r"learning_rate: 0\.001 then, 0\.1 now"):
        train(request_in(out, data, resume=True, settings={"learning_rate": 0.1}))
    with pytest.raises(CheckpointError, match="width: 8 then, 9 now"):
        train(replace(request_in(out, data, resume=True), config=replace(TINY, width=9)))


@pytest.fixture(scope="module")
def begun(tmp_path_factory, data):
    """The folder of a run that was killed at its third step."""
    out = tmp_path_factory.mktemp("begun") / "run"
    with pytest.raises(Killed):
        train(request_in(out, data), killer(4))
    return out


@pytest.mark.slow
def test_a_run_goes_on_with_its_own_data_only(tmp_path, data, begun):
    for name, walks in (("more", 6), ("less", 4)):
        folder = write_corpus(tmp_path / name, count=walks)
        with pytest.raises(CheckpointError, match=f"begun with other data .*clips: 5 then, {walks} now"):
            train(request_in(copied(begun, tmp_path / f"{name}-run"), folder, resume=True))
    swapped = shutil.copytree(data, tmp_path / "swapped")
    (swapped / "walk-1.bvh").write_bytes((data / "walk-2.bvh").read_bytes())
    with pytest.raises(CheckpointError, match=r"other data \(features: \w+ then, \w+ now\)"):
        train(request_in(copied(begun, tmp_path / "swapped-run"), swapped, resume=True))
    (tmp_path / "moved" / "walks").mkdir(parents=True)
    moved = shutil.copytree(data, tmp_path / "moved" / "walks", dirs_exist_ok=True)
    with pytest.raises(CheckpointError, match=r"other data \(clip names: \w+ then, \w+ now\)"):
        train(request_in(copied(begun, tmp_path / "moved-run"), moved.parent, resume=True))
    with pytest.raises(CheckpointError, match=r"other data \(match:  then, walk now\)"):
        train(request_in(copied(begun, tmp_path / "matched-run"), data, match="walk", resume=True))


def copied(run_folder, place):
    return shutil.copytree(run_folder, place)


def test_copied_data_are_the_same_data(tmp_path, data, begun):
    elsewhere = shutil.copytree(data, tmp_path / "elsewhere")
    assert train(request_in(copied(begun, tmp_path / "run"), elsewhere, resume=True)).exists()


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[]",
        "null",
        "[" * 100_000,
        '{"tensors": "gone"}',
        '{"curve": 3}',
        '{"curve": [3]}',
        '{"curve": [], "settings": 3}',
    ],
)
def test_a_broken_checkpoint_is_refused(tmp_path, data, content):
    out = tmp_path / "run"
    out.mkdir()
    (out / "checkpoint.json").write_text(content)
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        train(request_in(out, data, resume=True))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tensors", None),
        ("tensors", "checkpoint.json"),
        ("step", None),
        ("step", "three"),
        ("step", []),
        ("curve", None),
        ("settings", []),
        ("network", None),
        ("data", "all"),
    ],
)
def test_a_malformed_index_is_refused(tmp_path, data, begun, key, value):
    out = copied(begun, tmp_path / "run")
    index = json.loads((out / "checkpoint.json").read_text())
    for broken in (index | {key: value}, {name: index[name] for name in index if name != key}):
        (out / "checkpoint.json").write_text(json.dumps(broken))
        with pytest.raises(CheckpointError, match="no readable checkpoint"):
            train(request_in(out, data, resume=True))


@pytest.mark.parametrize("drop", ["generator", "model.fc1.weight", "optimiser.0.exp_avg"])
def test_a_checkpoint_without_a_tensor_is_refused(tmp_path, data, begun, drop):
    out = copied(begun, tmp_path / "run")
    (file,) = out.glob("step-*")
    tensors = load_file(file)
    del tensors[drop]
    save_file(tensors, file)
    with pytest.raises(CheckpointError, match="no readable checkpoint"):
        train(request_in(out, data, resume=True))


@pytest.mark.slow
@pytest.mark.parametrize("how", ["loss", "weights"])
def test_a_run_that_diverges_stops_and_keeps_its_last_good_checkpoint(tmp_path, data, monkeypatch, how):
    out, step = tmp_path / "run", DensityTrainer.train_step

    def diverging(trainer):
        if trainer.step == 3 and how == "weights":
            trainer.network.fc1.weight.data[0, 0] = torch.nan
            trainer.step += 1
            return {"loss": 1.0}
        if trainer.step == 3:
            trainer.windows.features = trainer.windows.features * torch.nan
        return step(trainer)

    monkeypatch.setattr(DensityTrainer, "train_step", diverging)
    with pytest.raises(MapctlError, match=r"training diverged at step 4: .*; the last checkpoint, .* is kept"):
        train(request_in(out, data))
    assert json.loads((out / "checkpoint.json").read_text())["step"] == 3
    assert not (out / "model.safetensors").exists()
    monkeypatch.undo()
    shorten_free_runs(monkeypatch)
    assert train(request_in(out, data, resume=True)).exists()


@pytest.mark.slow
def test_what_is_not_finite_is_null_in_the_curve(tmp_path, data, monkeypatch):
    monkeypatch.setattr(density_quality, "measure_free_runs", lambda model, corpus: {"free_run_speed_ratio": math.inf})
    card = priors.load(str(train(request_in(tmp_path / "run", data)))).card
    assert card.training["curve"][-1]["free_run_speed_ratio"] is None
    for file in (tmp_path / "run").glob("*.json"):
        json.loads(file.read_text(), parse_constant=pytest.fail)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"settings": {"steps": 0}}, "steps must be at least 1, got 0"),
        ({"settings": {"batch": -1}}, "batch must be at least 1, got -1"),
        ({"settings": {"window": 0}}, "window must be at least 1, got 0"),
        ({"settings": {"optimiser": "sgd"}}, "optimiser must be adam or rmsprop, got 'sgd'"),
        ({"settings": {"schedule": "none"}}, "schedule must be cosine or epochs, got 'none'"),
        ({"starts": 0}, "starts must be at least 1, got 0"),
    ],
)
def test_impossible_recipes_are_refused(tmp_path, data, change, message):
    with pytest.raises(RequestError, match=message):
        replace(request_in(tmp_path, data, settings=change.pop("settings", {})), **change)
    with pytest.raises(RequestError, match="width must be at least 1, got 0"):
        LstmGmmConfig(width=0)


def test_the_device_and_the_folder_are_checked_before_anything_is_read(tmp_path, data, monkeypatch):
    monkeypatch.setattr(corpora, "read_corpus", None)
    with pytest.raises(RequestError, match="auto, cpu or cuda"):
        train(replace(request_in(tmp_path / "run", data), device="abacus"))
    (tmp_path / "file").touch()
    with pytest.raises(RequestError, match="is not a folder"):
        train(request_in(tmp_path / "file", data))
    assert {place.name for place in tmp_path.iterdir()} == {"file"}


def test_a_trainer_leaves_the_callers_random_numbers_alone():
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = DensityTrainer(TINY, SETTINGS, corpus())
    assert torch.equal(torch.rand(3), expected)
    second = DensityTrainer(TINY, SETTINGS, corpus())
    assert torch.equal(first.network.fc1.weight, second.network.fc1.weight)


def test_each_window_is_mirrored_with_even_odds():
    trainer = DensityTrainer(TINY, replace(SETTINGS, batch=1), corpus())
    trainer.windows.starts = trainer.windows.starts[:1]
    plain = trainer.windows.features[: SETTINGS.window + 1]
    drawn = [trainer._draw_windows()[0][0] for _ in range(200)]
    mirrored = sum(torch.equal(window, mirror_features(plain)) for window in drawn)
    assert mirrored + sum(torch.equal(window, plain) for window in drawn) == 200
    assert 70 < mirrored < 130


def test_statistics_are_symmetric_and_floored():
    mean, std = compute_feature_statistics(corpus().features)
    torch.testing.assert_close(mirror_features(mean[None])[0], mean, atol=1e-5, rtol=0)
    assert float(std.min()) >= 0.001
    assert bool((mean[LAYOUT.continuous :] == 0.5).all())
    assert bool((std[LAYOUT.continuous :] == 0.5).all())


def test_free_runs_are_compared_with_the_data():
    data = corpus()
    found = MEASURE(DensityTrainer(TINY, SETTINGS, data).network, data, runs=4, frames=40)
    assert found["free_run_finite"] == 1
    assert found["free_run_speed_ratio"] == pytest.approx(1, abs=0.3)
    assert found["free_run_height_ratio"] == pytest.approx(1, abs=0.1)
    summary = summarise_states(encode(walk(60))[0].float())
    assert summary["speed"] == pytest.approx(1.24, abs=0.02)


def test_folders_that_cannot_be_trained_on_are_refused(tmp_path, data):
    with pytest.raises(RequestError, match="not a folder"):
        train(request_in(tmp_path / "run", tmp_path / "nowhere"))
    with pytest.raises(RequestError, match=r"no .bvh below .* matches 'dance'"):
        train(request_in(tmp_path / "run", data, match="dance"))
    with pytest.raises(RequestError, match="regular expression"):
        train(request_in(tmp_path / "run", data, match="walk("))
    with pytest.raises(RequestError, match=r"75 frames at 30 fps, and 75 to hold out in the longest clip; got .* 80$"):
        train(request_in(tmp_path / "run", data, match="walk-0"))
    with pytest.raises(RequestError, match="need a clip of 75 frames at 30 fps each; 0 of 5 clips"):
        train(request_in(tmp_path / "run", write_corpus(tmp_path / "short", frames=60)))
    with pytest.raises(RequestError, match="auto, cpu or cuda"):
        train(replace(request_in(tmp_path / "run", data), device="abacus"))
    assert not (tmp_path / "run" / "checkpoint.json").exists()


@pytest.mark.slow
def test_the_starts_of_a_density_are_chosen_by_its_labels(tmp_path, monkeypatch):
    write_corpus(tmp_path / "data")
    asked, select = [], lstm_gmm.select_initial_states
    monkeypatch.setattr(
        lstm_gmm, "select_initial_states", lambda *given, **named: asked.append(named) or select(*given, **named)
    )
    train(request_in(tmp_path / "run", tmp_path / "data", labels=r"(?P<clip>\d)\.bvh"))
    (given,) = asked
    assert given["labels"].tolist() == torch.eye(len(given["labels"])).tolist()
