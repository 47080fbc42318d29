"""Folders of clips as a corpus: read once, cached, split by clip; and what cannot be used is named."""

import json
from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import corpus, run

from mapctl.errors import MapctlError, RequestError
from mapctl.features import LAYOUT
from priors.training import corpus as corpora
from priors.training.mocap import clips
from priors.training.mocap.made import Made


def test_a_clip_that_cannot_be_used_is_named(tmp_path):
    # One joint that moves is a motion, but nobody's.
    head = [
        "HIERARCHY",
        "ROOT Ball",
        "{",
        "OFFSET 0 0 0",
        "CHANNELS 3 Xposition Yposition Zposition",
        "End Site",
        "{",
        "OFFSET 0 10 0",
        "}",
        "}",
        "MOTION",
        "Frames: 2",
        "Frame Time: 0.033333",
        "0 0 0",
        "1 0 0",
    ]
    (tmp_path / "odd.bvh").write_text("\n".join(head) + "\n")
    with pytest.raises(MapctlError, match=r"odd\.bvh: "):
        corpora.read_corpus(tmp_path, match="", cache=tmp_path / "cache")


def test_the_corpus_is_the_features_of_the_clips_and_is_read_once(tmp_path, data, monkeypatch):
    read = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert read.names == ("walk-0.bvh", "walk-1.bvh", "walk-2.bvh")
    expected = corpus(3, frames=80)
    torch.testing.assert_close(read.features, expected.features, atol=1e-5, rtol=1e-5)
    monkeypatch.setattr(clips, "read_clip_features", None)  # nothing can be read
    again = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert torch.equal(again.features, read.features)
    assert (again.names, again.lengths) == (read.names, read.lengths)
    (data / "walk-0.bvh").touch()
    with pytest.raises(RequestError, match="none of the 3"):  # a changed file is read anew
        corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)


@pytest.mark.parametrize("content", [b"", b"not a corpus", None])
def test_a_damaged_cache_is_read_anew(tmp_path, data, content):
    whole = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    (stored,) = tmp_path.iterdir()
    stored.write_bytes(stored.read_bytes()[:-100] if content is None else content)
    again = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert torch.equal(again.features, whole.features)
    assert corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path).names == whole.names


def test_a_cache_of_other_rig_tables_or_contact_thresholds_is_not_taken(tmp_path, data, monkeypatch):
    corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    table, contacts = corpora.rigs.known_rigs(), corpora.ContactSettings
    for what, other in (
        ("rigs.known_rigs", lambda: (*table[:-1], replace(table[-1], rest="straighten"))),
        ("ContactSettings", partial(contacts, slow=0.4)),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(f"priors.training.corpus.{what}", other)
            patch.setattr(clips, "read_clip_features", None)
            with pytest.raises(RequestError, match="none of the 3"):
                corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)


def test_the_split_is_by_clip_seeded_and_complete():
    many = corpora.Corpus(tuple(map(str, range(60))), (80,) * 60, torch.zeros(4800, LAYOUT.size))
    first, again, other = (corpora.split_corpus(many, seed) for seed in (1, 1, 2))
    parts = [set(part.names) for part in (first.train, first.validation, first.test)]
    assert [len(part) for part in parts] == [54, 3, 3]
    assert set.union(*parts) == set(many.names)
    assert first.test.names == again.test.names
    assert first.test.names != other.test.names


def test_windows_stay_within_their_clips():
    found = corpora.find_window_starts((5, 2, 4), 3).tolist()
    assert found == [0, 1, 2, 7, 8]
    with pytest.raises(RequestError, match="no clip is as long as the window of 9 frames"):
        corpora.find_window_starts((5, 2, 4), 9)


def test_a_share_of_the_clips_is_part_of_a_larger_share_and_keeps_the_held_out_ones():
    many = corpora.Corpus(
        tuple(map(str, range(60))),
        (80,) * 60,
        torch.arange(4800.0)[:, None].expand(-1, LAYOUT.size),
        made=Made(told=("1 of 60",)),
    )
    parts = corpora.split_corpus(many, 1)
    seen = []
    for share, count in ((0.25, 14), (0.5, 27), (1.0, 54)):
        kept, split = corpora.keep_share(many, parts, share, 1)
        assert len(split.train.names) == count
        assert (split.validation, split.test) == (parts.validation, parts.test)
        assert set(kept.names) == {*split.train.names, *parts.validation.names, *parts.test.names}
        assert kept.made == many.made
        first = [float(clip[0, 0]) for clip in split.train.clips()]
        assert first == [80.0 * int(name) for name in split.train.names]  # names stay with their frames
        seen.append(set(split.train.names))
    assert seen[0] < seen[1] < seen[2]
    assert (
        corpora.keep_share(many, parts, 0.25, 2)[1].train.names
        != corpora.keep_share(many, parts, 0.25, 1)[1].train.names
    )
    assert len(corpora.keep_share(many, parts, 1e-6, 1)[1].train.names) == 1


@pytest.mark.parametrize("share", [0.0, -0.5, 1.5, float("nan")])
def test_shares_that_make_no_sense_are_refused(share):
    many = corpus(6, 80)
    with pytest.raises(RequestError, match="above 0 and at most 1"):
        corpora.keep_share(many, corpora.split_corpus(many, 1), share, 1)


def test_a_share_of_clips_too_short_to_warm_up_on_is_refused():
    many = corpora.Corpus(tuple(map(str, range(60))), (20,) * 60, torch.zeros(1200, LAYOUT.size))
    parts = corpora.Split(many.subset(range(50)), many.subset(range(50, 55)), many.subset(range(55, 60)))
    with pytest.raises(RequestError, match=r"0\.1 of the clips to train on are 5, of 20 frames"):
        corpora.keep_share(many, parts, 0.1, 1)


@pytest.mark.slow
def test_a_run_on_a_share_of_the_data_says_so_and_is_measured_on_the_same_clips(tmp_path, data, fails):
    def card_of(name, *words):
        assert run("train", "keyframe-timing", "--data", str(data), "-o", str(tmp_path / name), "--quiet", *words) == 0
        return json.loads((tmp_path / name / "model.json").read_text())

    whole, half = card_of("whole"), card_of("half", "--data-share", "0.5")
    assert half["data"]["held_out"] == whole["data"]["held_out"]
    assert int(half["data"]["clips"]) < int(whole["data"]["clips"])
    assert "--data-share 0.5" in half["training"]["command"]
    assert 0.3 < half["data"]["trained_on"]["minutes"] / whole["data"]["trained_on"]["minutes"] < 0.7
    assert "--data-share" not in whole["training"]["command"]
    words = ("train", "keyframe-timing", "--data", str(data), "-o", str(tmp_path / "none"))
    assert "--data-share must be above 0 and at most 1, got 0" in fails(*words, "--data-share", "0")


def test_clips_that_a_model_made_are_never_held_out_and_change_nothing_about_the_others():
    names = tuple(f"b/{number:02d}" for number in range(40))
    frames = torch.arange(50 * 80.0)[:, None].expand(-1, LAYOUT.size)
    mocap = corpora.Corpus(names, (80,) * 40, frames[: 40 * 80])
    made = tuple(f"a/{number}" for number in range(10))
    both = corpora.Corpus((*made, *names), (80,) * 50, frames, made=Made(frozenset(made), ("10 of 50",)))
    alone, beside = (corpora.split_corpus(data, 3) for data in (mocap, both))
    assert beside.validation.names == alone.validation.names
    assert beside.test.names == alone.test.names
    assert set(beside.train.names) == {*alone.train.names, *made}
    assert not {*corpora.split_corpus(replace(both, made=Made()), 3).train.names} >= {*made}
