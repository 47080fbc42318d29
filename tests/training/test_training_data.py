"""What training does with files that cannot be used, and with very few clips."""

import shutil

import pytest
import torch
from helpers import bandai_skeleton, corpus, walks
from trainable_models import small_settings

from mapctl import retarget
from mapctl.errors import RequestError
from priors.training import data as corpora
from priors.training.recipes.denoiser import DenoiserTrainer

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
    (folder / "broken.bvh").write_text(text[:300])
    (folder / "empty.bvh").touch()
    (folder / "folder.bvh").mkdir()
    (folder / "lost.bvh").symlink_to(tmp_path / "gone")
    (folder / "other.bvh").write_text(f"{BALL}MOTION\nFrames: 2\nFrame Time: 0.04\n0 0 0\n1 0 0\n")
    write_walks(tmp_path / "short", 2, 1)
    shutil.copy(tmp_path / "short" / "walk-1.bvh", folder / "one.bvh")
    return folder


BAD = ("broken.bvh", "empty.bvh", "lost.bvh", "one.bvh", "other.bvh")


@pytest.mark.slow
def test_files_that_cannot_be_used_are_left_out_and_listed(tmp_path, data, mixed, capsys):
    found = small_settings("path", mixed, tmp_path / "run").gather().whole
    whole = small_settings("path", data, tmp_path / "whole").gather().whole
    assert found.names == whole.names
    assert torch.equal(found.features, whole.features)
    assert set(found.skipped) == set(BAD)
    assert capsys.readouterr().err.startswith(f"mapctl: left out 5 of 10 files: {mixed / 'broken.bvh'}: ")
    listed = (tmp_path / "run" / "skipped.txt").read_text().splitlines()
    assert [line.split(":")[0] for line in listed] == list(BAD)
    assert ONE_FRAME in listed


def test_a_folder_of_nothing_else_is_refused(tmp_path, mixed):
    with pytest.raises(RequestError, match=rf"none of the 1 \.bvh below .* can be trained on \({mixed / ONE_FRAME}\)"):
        small_settings("path", mixed, tmp_path / "run", match="one").gather()
    assert not (tmp_path / "run").exists()


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


def test_a_window_longer_than_what_is_held_out_does_not_end_a_run(tmp_path):
    trainer = DenoiserTrainer(small_settings("denoiser", tmp_path, tmp_path, window=90), corpus(2, 100))
    assert trainer.validate(corpus(1, 80))["error_cm"] > 0
