"""`mapctl train refiner`: its options reach the trainer, and what it writes refines what generate draws."""

from dataclasses import replace
from pathlib import Path

import pytest
from helpers import write_corpus
from tiny_prior import save_tiny_prior

import mapctl
from mapctl import cli
from mapctl.commands.train.options import TrainOptions
from priors.refiner.network import RefinerConfig
from priors.training import run
from priors.training.recipes.refiner import PAPER, AdversarialSettings


def requested(*words):
    command = cli.parse(["train", "refiner", "--data", "data", "-o", "run", *words])
    assert isinstance(command, TrainOptions)
    return command.recipe()


def test_what_is_not_asked_for_is_the_measured_recipe():
    given = requested()
    assert (given.config, given.settings) == (RefinerConfig(), AdversarialSettings())
    assert (given.data, given.out, given.density, given.match) == (Path("data"), Path("run"), "locomotion", None)
    assert not given.resume
    assert (requested("--paper").config, requested("--paper").settings) == PAPER


def test_every_option_reaches_the_trainer():
    given = requested(
        "--density",
        "mine",
        "--match",
        "walk",
        "--steps",
        "7",
        "--batch",
        "6",
        "--window",
        "20",
        "--seed",
        "3",
        "--bfloat16",
        "--resume",
        "--licence",
        "CC0",
        "--strict-data",
        "--minutes-between-checkpoints",
        "0.5",
    )
    assert (given.density, given.match, given.resume, given.licence) == ("mine", "walk", True, "CC0")
    assert (given.checkpoint_minutes, given.strict_data) == (0.5, True)
    assert given.settings == replace(
        AdversarialSettings(), rounds=7, batch=6, window=20, seed=3, bfloat16=True
    )  # the rest stays
    paper = requested("--paper", "--steps", "7")
    assert (paper.config, paper.settings) == (PAPER[0], replace(PAPER[1], rounds=7))


def test_help_names_what_a_refiner_takes(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["train", "refiner", "--help"])
    assert stop.value.code == 0
    told = capsys.readouterr().out
    for word in (
        "refiner",
        "--density",
        "--match",
        "--steps",
        "--batch",
        "--window",
        "--seed",
        "--paper",
        "--bfloat16",
        "--resume",
        "--minutes-between-checkpoints",
        "--licence",
    ):
        assert word in told


@pytest.mark.slow
def test_a_trained_refiner_is_used_by_generate(tmp_path, monkeypatch, capsys):
    train = run.train

    def tiny(request, say, *, warn, watchers):
        settings = replace(request.settings, window=10, batch=4, history=8, head_start=1, warm_up=1, critic_width=6)
        config = RefinerConfig(width=6, memory=5)
        return train(
            replace(request, config=config, settings=settings, samples=4, judged=1, seconds=1.5),
            say,
            warn=warn,
            watchers=watchers,
        )

    monkeypatch.setattr(run, "train", tiny)
    data, prior = write_corpus(tmp_path / "data"), str(save_tiny_prior(tmp_path / "tiny.safetensors"))
    words = ["train", "refiner", "--data", data, "-o", tmp_path / "run", "--density", prior, "--steps", 2]
    assert cli.main([str(word) for word in words]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "validation at round 2: " in told.out
    assert told.out.endswith(
        f"wrote {tmp_path / 'run' / 'model.safetensors'}; use it with --refiner {tmp_path / 'run'}\n"
    )
    words = ["generate", "-o", tmp_path / "gen", "--seconds", 1.5, "--prior", prior, "--refiner", tmp_path / "run"]
    assert cli.main([str(word) for word in words]) == 0
    assert mapctl.load(tmp_path / "gen" / "generated_000.bvh").num_frames == 45
