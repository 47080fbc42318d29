"""What training does with files that cannot be used, and with very few clips."""

import errno
import os
import shutil
from dataclasses import replace

import pytest
import tiny_denoiser
import tiny_infiller
import tiny_transformer
import torch
from captures import on_rig
from helpers import bandai_skeleton, corpus, run, walks

import priors
from mapctl import retarget
from mapctl.errors import RequestError
from priors.training import corpus as corpora
from priors.training import recipe as recipe_module
from priors.training import run as training_run
from priors.training.gathering import DataSource, gather
from priors.training.mocap import clips
from priors.training.recipes.denoiser import DenoiserSettings, DenoiserTrainer

BALL = (
    "HIERARCHY\nROOT Ball\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\nEnd Site\n{\nOFFSET 0 1 0\n}\n}\n"
)
ONE_FRAME = "one.bvh: features need at least two frames"


pytestmark = pytest.mark.usefixtures("small_judgements")


def write_walks(folder, *lengths):
    """Walks of so many frames, as BVH files of the Bandai Namco rig."""
    folder.mkdir(parents=True)
    rigmap = retarget.identify_rig(bandai_skeleton())
    for number, motion in enumerate(walks(len(lengths), max(lengths))):
        motion = motion.slice(0, lengths[number])
        retarget.from_canonical(motion, rigmap).save(folder / f"walk-{number}.bvh")
    return folder


@pytest.fixture
def mixed(tmp_path, data):
    """Five walks among files of every kind that a folder may hold."""
    folder = shutil.copytree(data, tmp_path / "data")
    text = (folder / "walk-0.bvh").read_text()
    (folder / "broken.bvh").write_text(text[: len(text) // 2])
    (folder / "empty.bvh").touch()
    (folder / "folder.bvh").mkdir()
    (folder / "lost.bvh").symlink_to(tmp_path / "gone")
    (folder / "other.bvh").write_text(f"{BALL}MOTION\nFrames: 2\nFrame Time: 0.04\n0 0 0\n1 0 0\n")
    write_walks(tmp_path / "short", 2, 1)
    shutil.copy(tmp_path / "short" / "walk-1.bvh", folder / "one.bvh")
    return folder


BAD = ("broken.bvh", "empty.bvh", "folder.bvh", "lost.bvh", "one.bvh", "other.bvh")


def gathered(folder, run_folder, **changes):
    """Corpus, and the lines of news and of warning."""
    news, warnings = [], []
    found, _ = gather(DataSource(folder, run_folder, **changes), progress=news.append, warn=warnings.append)
    return found, news, warnings


@pytest.mark.slow
def test_files_that_cannot_be_used_are_left_out_and_listed(tmp_path, data, mixed):
    found, news, (warning,) = gathered(mixed, tmp_path / "run")
    whole, *_ = gathered(data, tmp_path / "whole")
    assert found.names == whole.names
    assert torch.equal(found.features, whole.features)
    assert tuple(file.name for file in found.skipped) == BAD
    assert all(file.reason and file.name not in file.reason for file in found.skipped)
    assert warning.startswith(f"left out 6 of 11 files: {mixed / 'broken.bvh'}: ")
    assert "expected" in warning or "frames" in warning
    assert warning.endswith(f"; and 1 more; all are in {tmp_path / 'run' / 'skipped.txt'}")
    listed = (tmp_path / "run" / "skipped.txt").read_text().splitlines()
    assert [line.split(":")[0] for line in listed] == list(BAD)
    assert ONE_FRAME in listed
    assert any(line == "read 11 of 11 clips" for line in news)


def test_few_are_named_in_the_line_alone(tmp_path, mixed):
    _, _, (warning,) = gathered(mixed, tmp_path / "run", match="walk|one")
    assert warning == f"left out 1 of 6 files: {mixed / ONE_FRAME}"


def test_a_sound_folder_is_not_warned_of(tmp_path, data):
    _, _, warnings = gathered(data, tmp_path / "run", strict=True)
    assert warnings == []
    assert not (tmp_path / "run" / "skipped.txt").exists()


@pytest.mark.parametrize("cached", [False, True])
def test_strict_data_refuses_and_names_the_file(tmp_path, mixed, cached):
    if cached:
        gathered(mixed, tmp_path / "run", match="walk|one")
    with pytest.raises(RequestError, match=rf"^--strict-data: {mixed / ONE_FRAME}$"):
        gathered(mixed, tmp_path / "run", match="walk|one", strict=True)


def test_a_folder_of_nothing_else_is_refused(tmp_path, mixed):
    with pytest.raises(RequestError, match=rf"none of the 1 \.bvh below .* can be trained on \({mixed / ONE_FRAME}\)"):
        gathered(mixed, tmp_path / "run", match="one")
    assert not (tmp_path / "run").exists()


def test_a_fault_that_nobody_foresaw_leaves_one_file_out(tmp_path, data, monkeypatch):
    whole = clips.read_clip_features

    def odd(file, **told):
        return 1 / 0 if file.name == "walk-1.bvh" else whole(file, **told)

    monkeypatch.setattr(clips, "read_clip_features", odd)
    found, _, _ = gathered(data, tmp_path / "run")
    assert found.skipped == (corpora.SkippedFile("walk-1.bvh", "ZeroDivisionError: division by zero"),)


@pytest.mark.slow
def test_the_cache_knows_what_was_left_out_and_tries_it_again(tmp_path, mixed, monkeypatch):
    first, _, warned = gathered(mixed, tmp_path / "run")
    whole, read = clips.read_clip_features, []

    def counted(file, **told):
        read.append(file.name)
        return whole(file, **told)

    monkeypatch.setattr(clips, "read_clip_features", counted)
    again, _, warned_again = gathered(mixed, tmp_path / "run")
    assert (again.skipped, warned_again) == (first.skipped, warned)
    assert set(read) == set(BAD)

    def mended(file, **told):
        return whole(mixed / "walk-1.bvh" if file.name == "lost.bvh" else file, **told)

    monkeypatch.setattr(
        clips, "read_clip_features", mended
    )  # a drive that is there again: the files' dates are the same
    after, _, _ = gathered(mixed, tmp_path / "run")
    assert [name for name in after.names if name not in first.names] == ["lost.bvh"]


def train_words(model, data, out, *words):
    return ("train", model, "--data", data, "-o", out, "--steps", 2, "--batch", 3, *words)


MODELS = {
    "lstm-gmm": (("--width", 8, "--components", 2, "--window", 20, "--device", "cpu"), priors.load),
    "denoiser": ((), priors.load_denoiser),
    "infiller": (("--window", 32), priors.load_infiller),
    "pose-transformer": (("--window", 32), priors.load_transformer),
}


@pytest.fixture(params=MODELS)
def model(request, monkeypatch):
    """Its name, words for a small one, and what loads it."""
    tiny = {
        "denoiser": tiny_denoiser.CONFIG,
        "infiller": tiny_infiller.CONFIG,
        "pose-transformer": tiny_transformer.CONFIG,
    }
    if request.param in tiny:
        config, train = tiny[request.param], training_run.train
        monkeypatch.setattr(
            training_run,
            "train",
            lambda recipe, *words, **options: train(replace(recipe, config=config), *words, **options),
        )
    return (request.param, *MODELS[request.param])


@pytest.mark.slow
def test_the_command_leaves_out_lists_and_says_it_in_the_card(tmp_path, mixed, model, capsys):
    name, words, load = model
    assert run(*train_words(name, mixed, tmp_path / "run", *words, "--match", "walk|one", "--quiet")) == 0
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", f"mapctl: left out 1 of 6 files: {mixed / ONE_FRAME}\n")
    assert load(str(tmp_path / "run")).card.data["skipped"] == {"one.bvh": ONE_FRAME.split(": ")[1]}
    refused = tmp_path / "refused"
    assert run(*train_words(name, mixed, refused, *words, "--match", "walk|one", "--quiet", "--strict-data")) == 2
    assert capsys.readouterr().err == f"mapctl: --strict-data: {mixed / ONE_FRAME}\n"
    assert not (refused / "checkpoint.json").exists()


@pytest.mark.parametrize(
    "lengths",
    [(80, 76), (160,), *(pytest.param(many, marks=pytest.mark.slow) for many in ((160, 40), (90, 90, 90)))],
    ids=str,
)
def test_few_clips_are_enough(tmp_path, model, lengths, capsys):
    name, words, load = model
    data = write_walks(tmp_path / "data", *lengths)
    assert run(*train_words(name, data, tmp_path / "run", *words)) == 0
    held = f"walk-0.bvh[{lengths[0] - 75}:{lengths[0]}]"
    assert f", without {held} (frames at 30 fps), which is held out\n" in capsys.readouterr().out
    card = load(str(tmp_path / "run")).card
    assert card.data["held_out"] == {"validation": [held], "test": [held]}
    assert int(card.data["clips"]) == len(lengths)


@pytest.mark.slow
def test_a_density_of_many_is_tuned_on_two(tmp_path, data):
    words = MODELS["lstm-gmm"][0]
    assert run(*train_words("lstm-gmm", data, tmp_path / "first", *words)) == 0
    two = write_walks(tmp_path / "two", 100, 100)
    tuned = ("--init", tmp_path / "first", "--window", 20, "--device", "cpu", "--learning-rate", 3e-4)
    assert run(*train_words("lstm-gmm", two, tmp_path / "tuned", *tuned)) == 0
    assert (
        priors.load(str(tmp_path / "tuned")).reference.config == priors.load(str(tmp_path / "first")).reference.config
    )


def test_of_few_clips_the_end_of_the_longest_is_held_out():
    few = corpora.Corpus(("a", "b"), (100, 1000), corpus(11).features)
    parts = corpora.split_corpus(few, 1)
    assert (parts.train.names, parts.train.lengths) == (("a", "b"), (100, 890))
    assert parts.test is parts.validation
    assert (parts.test.names, parts.test.lengths) == (("b[890:1000]",), (110,))
    assert torch.equal(torch.cat([parts.train.features, parts.test.features]), few.features)


def test_what_is_left_of_a_clip_is_no_clip_where_it_is_a_frame():
    few = corpora.Corpus(("a", "b"), (76, 76), corpus(2, 76).features)
    assert corpora.split_corpus(few, 1).train.names == ("b",)


@pytest.mark.parametrize(("lengths", "got"), [((74, 70), "74, 70"), ((100,), "100"), ((149,), "149")])
def test_too_little_is_refused_with_what_would_do(lengths, got):
    few = corpora.Corpus(tuple("ab"[: len(lengths)]), lengths, torch.zeros(sum(lengths), corpus(1).features.shape[1]))
    message = f"training needs 75 frames at 30 fps, and 75 to hold out in the longest clip; got clips of {got}"
    with pytest.raises(RequestError, match=f"^{message}$"):
        corpora.split_corpus(few, 1)


def test_five_clips_are_held_out_whole():
    parts = corpora.split_corpus(corpus(5), 1)
    assert [len(part.names) for part in (parts.train, parts.validation, parts.test)] == [3, 1, 1]


def test_a_window_longer_than_what_is_held_out_does_not_end_a_run():
    settings = DenoiserSettings(steps=1, batch=2, window=90)
    trainer = DenoiserTrainer(tiny_denoiser.CONFIG, settings, corpus(2, 100))
    assert trainer.validate(corpus(1, 80))["error_cm"] > 0


def test_every_file_may_have_a_rig_of_its_own(tmp_path):
    """Each is brought onto the canonical joints; one that is no person is left out and counted."""
    folder = tmp_path / "rigs"
    folder.mkdir()
    rigs = ("bandai", "canonical", "daz")
    for name in rigs:
        on_rig(name, 160).save(folder / f"{name}.bvh")
    (folder / "ball.bvh").write_text(BALL + "MOTION\nFrames: 2\nFrame Time: 0.1\n0 0 0\n0 0 0\n")
    (folder / "LOUD.BVH").write_bytes((folder / "daz.bvh").read_bytes())
    found, _, (warning,) = gathered(folder, tmp_path / "run")
    assert found.names == ("LOUD.BVH", *(f"{name}.bvh" for name in rigs))
    assert warning.startswith(f"left out 1 of 5 files: {folder / 'ball.bvh'}: ")
    parts = dict(zip(found.names, found.clips(), strict=True))
    assert torch.allclose(parts["canonical.bvh"], parts["bandai.bvh"], atol=0.02)
    assert torch.equal(parts["LOUD.BVH"], parts["daz.bvh"])


def test_folders_that_cannot_be_looked_into_are_named(tmp_path, data, monkeypatch):
    """Without the permissions of the one who runs this test, which may be everyone's."""
    whole = os.walk

    def closed(top, onerror):
        onerror(PermissionError(errno.EACCES, "Permission denied", str(data / "private")))
        return whole(top, onerror=onerror)

    monkeypatch.setattr(corpora.os, "walk", closed)
    found, _, (warning,) = gathered(data, tmp_path / "run")
    assert len(found.names) == 5
    assert warning == f"left out 1 of 6 files: {data / 'private'}: Permission denied"
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr(corpora.os, "walk", lambda top, onerror: whole(top, onerror=onerror))
    with pytest.raises(RequestError, match=f"^no .bvh below {tmp_path / 'empty'}$"):
        gathered(tmp_path / "empty", tmp_path / "run")
    monkeypatch.setattr(recipe_module.os, "access", lambda path, mode: False)
    assert run(*train_words("infiller", data, tmp_path / "none")) == 2
    assert not (tmp_path / "none").exists()
