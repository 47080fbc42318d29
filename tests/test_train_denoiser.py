"""`mapctl train denoiser` on five synthetic clips, and the steps it is made of."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from helpers import corpus, generator, killing

import priors
from mapctl import cli
from mapctl.capture import Capture
from mapctl.commands import train_denoiser
from mapctl.commands.train import Train
from mapctl.errors import CheckpointError, MapctlError, RequestError
from mapctl.features import LAYOUT
from priors.denoiser import DenoiserConfig
from priors.training.corpus import Corpus
from priors.training.corruption import CorruptionSettings, clean_capture
from priors.training.denoiser import DenoiserSettings, DenoiserTrainer, Windows, joint_positions, losses, validate
from priors.training.denoiser_run import DenoiserRequest, command, train

TINY = DenoiserConfig(width=8, dilations=(1, 2))
SETTINGS = DenoiserSettings(steps=6, batch=3, window=16)


@pytest.fixture
def request_in(data):
    """Checkpoints in every step, so that a kill can come anywhere."""

    def made(out, **changes):
        settings = replace(SETTINGS, **changes.pop("settings", {}))
        given = {"checkpoint_minutes": 0.0, "report_steps": 2, "validate_steps": 4, "config": TINY} | changes
        return DenoiserRequest(data, out, settings=settings, **given)

    return made


def killed_in(request, number):
    """Runs until a step is begun."""
    with killing(DenoiserTrainer, "train_step", number, counter="step"):
        train(request)


def test_killed_and_resumed_is_the_uninterrupted_run_to_the_bit(tmp_path, request_in):
    whole = train(request_in(tmp_path / "whole"))
    killed_in(request_in(tmp_path / "parts"), 3)
    killed_in(request_in(tmp_path / "parts", resume=True), 4)
    news = []
    parts = train(request_in(tmp_path / "parts", resume=True), news.append)
    assert "resumed at step 4" in news
    for name in (whole.name, "model.json", "step-6-checkpoint.safetensors", "checkpoint.json"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert parts == tmp_path / "parts" / "model.safetensors"


def test_a_finished_run_loads_with_a_complete_card(tmp_path, request_in):
    news, out = [], tmp_path / "run"
    train(request_in(out, licence="CC0"), news.append)
    found = priors.load_denoiser(str(out))
    card = found.card
    assert (card.kind, card.licence, found.network.config) == ("denoiser", "CC0", TINY)
    assert (card.data["clips"], card.data["frames"]) == ("5", "400")
    assert card.training["settings"] == json.loads(json.dumps(asdict(SETTINGS)))
    assert [row["step"] for row in card.training["curve"]] == [4, 6]
    assert all(math.isfinite(value) for value in card.quality["test"].values())
    assert set(card.data["held_out"]) == {"validation", "test"}
    assert [line.split(":")[0] for line in news if line.startswith("step")] == ["step 2", "step 4", "step 6"]


def test_resuming_is_asked_for_and_needs_the_same_recipe_network_and_data(tmp_path, request_in):
    out = tmp_path / "run"
    with pytest.raises(CheckpointError, match="no checkpoint to resume"):
        train(request_in(out, resume=True))
    killed_in(request_in(out), 2)
    with pytest.raises(RequestError, match="already holds a run; pass --resume"):
        train(request_in(out))
    with pytest.raises(CheckpointError, match=r"other settings \(feet: 0\.5 then, 3\.0 now\)"):
        train(request_in(out, resume=True, settings={"feet": 3.0}))
    with pytest.raises(CheckpointError, match=r"other network \(width: 8 then, 7 now\)"):
        train(request_in(out, resume=True, config=replace(TINY, width=7)))
    with pytest.raises(CheckpointError, match="other data"):
        train(request_in(out, resume=True, match="walk-[0-3]"))


def test_what_cannot_be_trained_on_is_refused(tmp_path, request_in):
    with pytest.raises(RequestError, match="not a folder of BVH"):
        train(replace(request_in(tmp_path / "run"), data=tmp_path / "nowhere"))
    with pytest.raises(RequestError, match=r"no .bvh below .* matches 'dance'"):
        train(request_in(tmp_path / "run", match="dance"))
    with pytest.raises(RequestError, match="no clip is as long as the window"):
        train(request_in(tmp_path / "run", settings={"window": 90}))
    with pytest.raises(RequestError, match="window must be at least 16"):
        DenoiserSettings(window=15)
    assert not (tmp_path / "run" / "checkpoint.json").exists()


def test_a_diverged_run_stops_with_its_last_checkpoint(tmp_path, request_in, monkeypatch):
    step = DenoiserTrainer.train_step
    monkeypatch.setattr(DenoiserTrainer, "train_step",
                        lambda trainer: step(trainer) | ({"loss": math.nan} if trainer.step == 3 else {}))  # fmt: skip
    with pytest.raises(MapctlError, match="diverged at step 3"):
        train(request_in(tmp_path / "run"))
    assert json.loads((tmp_path / "run" / "checkpoint.json").read_text())["step"] == 2
    assert not (tmp_path / "run" / "model.safetensors").exists()


def requested(*words):
    given = cli.parse(["train", "denoiser", "--data", "data", "-o", "run", *words])
    assert isinstance(given, Train)
    return train_denoiser.request(given)


def test_every_option_reaches_the_trainer():
    given = requested()
    assert (given.config, given.settings, given.match, given.resume) == (
        DenoiserConfig(),
        DenoiserSettings(),
        "",
        False,
    )
    assert (given.data, given.out) == (Path("data"), Path("run"))
    given = requested("--match", "walk", "--steps", "7", "--batch", "6", "--window", "20", "--seed", "0",
                      "--learning-rate", "0.01", "--width", "12", "--bfloat16", "--resume", "--licence", "CC0",
                      "--skip-first", "--minutes-between-checkpoints", "0.5")  # fmt: skip
    assert (given.match, given.resume, given.licence, given.skip_first) == ("walk", True, "CC0", True)
    assert (given.checkpoint_minutes, given.config) == (0.5, DenoiserConfig(width=12))
    assert given.settings == replace(DenoiserSettings(), steps=7, batch=6, window=20, seed=0, learning_rate=0.01,
                                     bfloat16=True)  # fmt: skip


@pytest.mark.parametrize("words", [["--density", "mine"], ["--components", "3"], ["--labels", "(?P<a>b)"],
                                   ["--init", "locomotion"], ["--paper"]], ids=lambda words: words[0])  # fmt: skip
def test_options_of_other_models_are_refused(words):
    with pytest.raises(RequestError, match=f"{words[0]} is for other models"):
        requested(*words)


@pytest.mark.parametrize(("words", "message"), [
    (["--steps", "0"], "--steps must be at least 1, got 0"), (["--batch", "-2"], "--batch must be at least 1"),
    (["--window", "0"], "--window must be at least 1"), (["--window", "8"], "window must be at least 16"),
    (["--width", "0"], "--width must be at least 1"), (["--seed", "-1"], "seed"),
    (["--learning-rate", "2"], "learning rate"), (["--learning-rate", "0"], "learning rate"),
    (["--minutes-between-checkpoints", "0"], "minutes between"), (["--device", "cuda"], "leave --device out"),
], ids=lambda value: value[0] if isinstance(value, list) else "")  # fmt: skip
def test_numbers_that_make_no_sense_are_refused(words, message):
    with pytest.raises(RequestError, match=message):
        requested(*words)


def test_the_command_of_a_card_asks_for_the_same_run(tmp_path, data):
    settings = replace(DenoiserSettings(), steps=7, bfloat16=True, seed=3, learning_rate=2e-4)
    wanted = DenoiserRequest(data, tmp_path, match="walk-[01]", config=DenoiserConfig(width=12), settings=settings,
                             skip_first=True)  # fmt: skip
    words = command(wanted).replace("'", "").replace("DATA", str(data)).replace("RUN", str(tmp_path)).split()
    given = cli.parse(words[1:])
    assert isinstance(given, Train)
    assert train_denoiser.request(given) == wanted


def test_the_command_line_trains_what_denoise_can_load(tmp_path, data, capsys):
    words = ["train", "denoiser", "--data", data, "-o", tmp_path / "run", "--steps", 2, "--batch", 2, "--window", 16,
             "--width", 8]  # fmt: skip
    assert cli.main([str(word) for word in words]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert told.out.endswith(f"wrote {tmp_path / 'run' / 'model.safetensors'}; use it with --denoiser"
                             f" {tmp_path / 'run'}\n")  # fmt: skip
    assert priors.load_denoiser(str(tmp_path / "run")).network.config.width == 8


def test_windows_are_clips_mirrored_half_of_the_time():
    plain = replace(SETTINGS, calibration_deg=0.0, batch=64, corruption=CorruptionSettings(size=0.0))
    whole = corpus(2, 40)
    drawn = Windows(whole, plain).draw(generator())
    assert drawn.shape == (64, 16, LAYOUT.size)
    every = whole.features.unfold(0, 16, 1).transpose(1, 2)
    same = torch.cdist(drawn.flatten(1), every.flatten(1)).amin(dim=1) < 1e-3
    assert 0.3 < same.double().mean() < 0.7
    assert torch.equal(drawn, Windows(whole, plain).draw(generator()))
    assert not torch.equal(drawn, Windows(whole, plain).draw(generator(1)))


def test_small_folders_are_drawn_more_often_where_evenness_asks_for_it():
    clip = corpus(1, 60).features
    uneven = Corpus(("big/a", "big/b", "big/c", "small/d"), (60, 60, 60, 30),
                    torch.cat([clip, clip, clip, clip[:30] + 100]))  # fmt: skip

    def share(evenness):
        windows = Windows(uneven, replace(SETTINGS, batch=600, evenness=evenness)).draw(generator())
        return float((windows[:, 0, LAYOUT.slices["root_height"]] > 50).double().mean())

    assert share(0.0) == pytest.approx(0.1, abs=0.05)
    assert share(1.0) == pytest.approx(0.5, abs=0.07)


def test_a_rig_calibrated_otherwise_stands_as_still(monkeypatch):
    """Joint frames turned by a constant: what does not move still does not, the hips' place stays."""
    still = corpus(1, 16).features[:1].expand(16, -1).contiguous()
    settings = replace(SETTINGS, batch=20, calibration_deg=10.0, corruption=CorruptionSettings(size=0.0))
    drawn = Windows(Corpus(("a",), (16,), still), settings).draw(generator())
    joints = LAYOUT.pick(drawn, "joint_rotations")
    assert torch.diff(joints, dim=1).abs().max() < 1e-5
    turned = (joints - joints[:1]).abs().amax(dim=(1, 2)) > 0.05
    assert 0.2 < turned.double().mean() < 1


def test_positions_of_a_clean_capture_are_those_of_its_motion():
    from mapctl.capture import Cleaned
    from mapctl.features import Place, decode

    features = corpus(1, 30).features
    capture: Capture = clean_capture(features[None])
    angles = torch.cat([capture.tilt, capture.joints.flatten(2)], dim=-1)
    found = joint_positions(Cleaned(capture.root, capture.heading, angles, LAYOUT.pick(features[None], "contacts")))
    place = Place(torch.zeros(2, dtype=torch.float64), torch.zeros((), dtype=torch.float64))
    wanted = decode(features.double(), place).joint_positions()
    assert (found[0] - wanted).abs().max() < 1e-4


def test_a_perfect_proposal_costs_nothing_but_contacts():
    from tiny_denoiser import network

    clean = replace(SETTINGS, corruption=CorruptionSettings(
        clean=1.0, markers=0.0, spikes=0.0, dropout=0.0, limb=0.0, gap=0.0))  # fmt: skip
    parts = losses(network(), corpus(1, 30).features[None], clean, generator())
    assert parts["error_cm"] < 0.05
    assert parts["angles_deg"] < 0.01
    assert parts["contacts_nats"] == pytest.approx(math.log(2), rel=1e-3)  # untrained it does not know
    assert parts["loss"] == pytest.approx(clean.contacts * math.log(2), abs=0.1)


def test_the_loss_falls_on_windows_that_it_sees_again_and_again():
    settings = DenoiserSettings(steps=50, batch=6, window=24, learning_rate=3e-3)
    trainer = DenoiserTrainer(DenoiserConfig(width=24, dilations=(1, 2)), settings, corpus(1, 30))
    rows = []
    for _ in range(50):
        trainer.generator.manual_seed(1)  # the same windows, spoilt in the same way
        rows.append(trainer.train_step())
    for name, share in (("loss", 0.6), ("error_cm", 0.6), ("contacts_nats", 0.9)):
        assert rows[-1][name] < share * rows[0][name]


def test_validation_is_the_same_each_time():
    trainer = DenoiserTrainer(TINY, SETTINGS, corpus(1, 30))
    first, again = (validate(trainer.network, corpus(2, 30), SETTINGS) for _ in range(2))
    assert first == again
    assert set(first) == {"loss", "error_cm", "feet_cm_frame", "angles_deg", "contacts_nats"}


def test_in_bfloat16_it_trains_too():
    trainer = DenoiserTrainer(TINY, replace(SETTINGS, bfloat16=True), corpus(1, 24))
    assert all(math.isfinite(value) for _ in range(2) for value in trainer.train_step().values())
    assert all(value.dtype == torch.float32 for value in trainer.network.state_dict().values())
