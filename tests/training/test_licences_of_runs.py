"""Under which licence a trained model is, and which model it began with: as its card tells, and as marks go by."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import run, write_corpus

import priors
from mapctl import cli
from mapctl.commands.train.whole_set.licensing import license_models
from mapctl.errors import CheckpointError, RequestError
from priors import checkpoints, licences, weight_sets
from priors.checkpoints import Card
from priors.training import corpus as corpora
from priors.training.bundled.models import list_models
from priors.training.mocap.made import COLUMNS

CARD = Card("path", {}, licence="CC BY-NC 4.0", **Card.layout_fields())


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_corpus(tmp_path_factory.mktemp("clips"))


@pytest.fixture
def train_path(tmp_path, data):
    """Trains a path predictor for a step, and reads its card."""

    def typed(*words, out="run"):
        words = ("--data", data, "-o", tmp_path / out, "--steps", 1, "--batch", 4, "--quiet", *words)
        assert run("train", "path", *words) == 0
        return checkpoints.read_card(tmp_path / out / "model.json")

    return typed


def ask(*words):
    return cli.parse(["train", "all", *map(str, words)])


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("licence", ["", "  ", "two\nlines"])
def test_a_licence_is_one_line_of_text(tmp_path, data, capsys, licence):
    for words in (("denoiser",), ("all",)):
        assert run("train", *words, "--data", data, "-o", tmp_path / "run", "--licence", licence) == 2
        assert "--licence must be one line of text" in capsys.readouterr().err


def test_a_model_whose_card_tells_no_licence_is_in_every_mark(tmp_path):
    checkpoints.save({"weights": torch.zeros(1)}, replace(CARD, licence=""), tmp_path / "own.safetensors")
    with licences.record_licences() as used:
        checkpoints.note_use(str(tmp_path / "own.safetensors"))
        licences.note_licence("free/path", "free for any use")
    assert list(used.values()) == [licences.NONE_TOLD, "free for any use"]
    assert licences.find_strictest(used.values()) == licences.NONE_TOLD


@pytest.mark.slow
def test_a_run_that_goes_on_keeps_its_licence(train_path):
    assert train_path().licence == licences.OF_DATA
    assert train_path("--licence", "CC0 1.0", out="own").licence == "CC0 1.0"
    words = ("--resume", "--steps", 2)
    assert train_path(*words, out="own").licence == "CC0 1.0"
    assert train_path("--resume", "--steps", 3, "--licence", "mine", out="own").licence == "mine"


@pytest.mark.slow
def test_a_card_names_the_model_that_training_began_with(train_path, tmp_path, monkeypatch, data, capsys):
    train_path("--licence", "mine alone", out="set/path")
    card = checkpoints.read_card(tmp_path / "set/path/model.json")
    (tmp_path / "set/path/model.json").rename(tmp_path / "set/path.json")
    (tmp_path / "set/path/model.safetensors").rename(tmp_path / "set/path.safetensors")
    assert "init" not in card.data
    monkeypatch.setenv(weight_sets.FOLDER_VARIABLE, str(tmp_path / "set"))
    tuned = train_path("--init", "path", "--learning-rate", 0.0001, out="tuned")
    assert tuned.data["init"] == {"name": "full/path", "licence": "mine alone"}
    assert "--init full/path" in tuned.training["command"]
    assert tuned.licence == f"{licences.OF_DATA}; mine alone"
    again = train_path("--init", tmp_path / "tuned", "--learning-rate", 0.0001, "--licence", "my own", out="again")
    assert again.data["init"] == {"name": "tuned", "licence": tuned.licence}
    assert "--init INIT" in again.training["command"]
    told = {"data": again.data, "training": {}}
    with pytest.raises(CheckpointError, match="it began with 'tuned', whose licence is 'that of the training data"):
        licences.check_free("free/path", "CC0 1.0", told)
    words = ("--data", data, "-o", tmp_path / "freed", "--init", tmp_path / "tuned", "--licence", "CC0 1.0")
    assert run("train", "path", *words) == 2
    assert "tuned is under 'that of the training data; mine alone'; weights that learn from it cannot be 'CC0 1.0'" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("licence", "theirs", "refused"),
    [
        ("free for any use", "CC BY-NC 4.0", True),
        ("CC BY 4.0", "CC BY-NC 4.0", True),
        ("CC0 1.0", licences.OF_DATA, True),
        ("CC BY-NC 4.0", "CC BY 4.0", False),
        ("CC BY 4.0", licences.OF_DATA, False),  # whose is not known, but to who says it
        ("a contract of 3 May", "CC BY-NC 4.0", False),
        (licences.OF_DATA, licences.OF_DATA, False),
        ("free for any use", "free for any use", False),
    ],
)
def test_weights_are_not_freer_than_what_they_learn_from(licence, theirs, refused):
    if not refused:
        return licences.check_not_laxer(licence, {"that": theirs})
    with pytest.raises(RequestError, match=f"that is under '{theirs}'"):
        licences.check_not_laxer(licence, {"that": theirs})


@pytest.mark.parametrize(
    ("kind", "words", "teacher"),
    [
        ("lstm-gmm", ("--init", "full/general"), "full/general"),
        ("lstm-gmm", ("--splices", 2, "--stitcher", "full/stitcher"), "full/stitcher"),
        ("refiner", ("--density", "full/locomotion"), "full/locomotion"),
        ("tweener", ("--path", "full/path"), "full/path"),
        ("denoiser", ("--init", "full/denoiser"), "full/denoiser"),
    ],
)
def test_nothing_free_is_learnt_from_a_model_that_is_not(tmp_path, data, capsys, kind, words, teacher):
    words = ("--data", data, "-o", tmp_path / "run", *words, "--licence", "free for any use")
    assert run("train", kind, *words) == 2
    assert f"mapctl: {teacher} is under 'CC BY-NC 4.0'; weights that learn" in capsys.readouterr().err


def test_nothing_free_sees_clips_that_a_model_made_which_is_not(tmp_path, data, capsys):
    made = shutil.copytree(data, tmp_path / "made")
    names = sorted(file.name for file in made.rglob("*.bvh"))
    rows = "".join(f"{name},yes,locomotion,CC BY-NC 4.0,1,walk.toml,\n" for name in names)
    (made / "made.csv").write_text(f"{','.join(COLUMNS)}\n{rows}")
    words = ("--data", made, "-o", tmp_path / "run", "--licence", "CC BY 4.0")
    assert run("train", "denoiser", *words) == 2
    assert "a clip that a model made is under 'CC BY-NC 4.0'" in capsys.readouterr().err


@pytest.mark.slow
def test_clips_that_an_initial_model_has_seen_are_not_held_out_by_another_split(train_path, tmp_path, data, capsys):
    train_path("--split-seed", 3, out="first")
    assert train_path("--init", tmp_path / "first", out="second").data["split_seed"] == 3
    assert train_path("--init", tmp_path / "first", "--split-seed", 3, out="third").data["split_seed"] == 3
    words = ("--data", data, "-o", tmp_path / "fourth", "--steps", 1, "--init", tmp_path / "first", "--split-seed", 7)
    assert run("train", "path", *words) == 2
    assert "has clips kept from it by seed 3" in capsys.readouterr().err


def test_a_folder_of_a_bundled_name_is_not_that_model(tmp_path, train_path, monkeypatch):
    bundled = checkpoints.locate("path")
    train_path(out="path")
    monkeypatch.chdir(tmp_path)
    assert checkpoints.locate("path") == bundled
    assert priors.add_set("path") == "full/path"
    assert checkpoints.locate("./path") == Path("path/model.safetensors")
    assert weight_sets.write_path(Path("path")) == "./path"
    assert weight_sets.write_path(Path("set/path")) == "set/path"


@pytest.mark.parametrize(
    ("names", "words", "licence"),
    [
        (["cmu/02_01.bvh", "bandai-namco-2/data/dataset-2_walk_a_001.bvh"], [], "CC BY-NC 4.0"),
        (["cmu/02_01.bvh", "mine/stroll.bvh"], [], licences.OF_DATA),
        (["cmu_of_mine/02_01.bvh"], [], licences.OF_DATA),
        (["cmu_of_mine/02_01.bvh"], ["--weights", "free"], licences.OF_DATA),
        (["cmu/02_01.bvh", "bandai-namco-2/data/dataset-2_walk_a_001.bvh"], ["--weights", "free"], "free for any use"),
        (["cmu/02_01.bvh", "mine/stroll.bvh"], ["--weights", "free", "--match", "stroll"], licences.OF_DATA),
        (["mine/stroll.bvh"], ["--match", "stroll", "--licence", "CC BY 4.0"], "CC BY 4.0"),
    ],
)
def test_a_set_has_its_licence_only_of_its_own_clips(tmp_path, names, words, licence):
    given = ask("--data", touch(tmp_path, *names), "-o", tmp_path / "set", *words)
    models = license_models(given, list_models(given.weights, match=given.match))
    assert {model.recipe.licence for model in models} == {licence}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cmu/dataset-2_walk_a_001.bvh", []),
        ("bandai/dataset-2_walk_a_001.bvh", ["--match", "walk", "--licence", "free for any use"]),
    ],
)
def test_free_weights_see_no_clip_that_is_known_not_to_be(tmp_path, name, words):
    folder = touch(tmp_path, name, "cmu/02_01.bvh")
    given = ask("--data", folder, "-o", tmp_path / "set", "--weights", "free", *words)
    with pytest.raises(RequestError, match=r"dataset-2_walk_a_001.bvh is not free"):
        license_models(given, list_models("free", match=given.match))


def test_a_bad_pattern_is_refused_before_anything_is_written(tmp_path, data, capsys):
    assert run("train", "all", "--data", data, "-o", tmp_path / "set", "--match", "(") == 2
    assert run("train", "all", "--commands", "--match", "(") == 2
    assert capsys.readouterr().err.count("--match must be a regular expression, got '('") == 2
    assert not (tmp_path / "set").exists()


def test_sets_differ_by_a_percentage_that_is_no_less_than_none(tmp_path, capsys):
    assert run("train", "all", "--compare", tmp_path, tmp_path, "--within", "-5") == 2
    assert "--within must be at least 0, got -5" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(6))
def test_short_clips_are_not_all_that_is_held_out(seed):
    """A part that has only short ones gets a long one in exchange; who has enough of them keeps its split."""
    lengths = (44, 40, 300, 44, 280, 43, 260, 90)
    clips = corpora.Corpus(tuple(f"{i}" for i in range(8)), lengths, torch.zeros(sum(lengths), 2))
    parts = corpora.split_corpus(clips, seed)
    assert all(max(part.lengths) >= 75 for part in (parts.train, parts.validation, parts.test))
    named = [name for part in (parts.train, parts.validation, parts.test) for name in part.names]
    assert sorted(named) == sorted(clips.names)
    long = replace(clips, lengths=(200,) * 8, features=torch.zeros(1600, 2))
    order = torch.randperm(8, generator=torch.Generator().manual_seed(seed)).tolist()
    assert corpora.split_corpus(long, seed).validation.names == (str(order[0]),)
    few = replace(clips, lengths=(44, 40, 300, 44, 280, 43, 60, 60), features=torch.zeros(871, 2))
    with pytest.raises(RequestError, match="2 of 8 clips are that long"):
        corpora.split_corpus(few, seed)
