"""Folders of clips as a corpus: read once, cached, split by clip; and what cannot be used is named."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import corpus

from mapctl.errors import RequestError
from mapctl.features import LAYOUT
from priors.training import data as corpora


def test_the_corpus_is_the_features_of_the_clips_and_is_read_once(tmp_path, data, monkeypatch):
    read = corpora.read_corpus(data, match="walk-[0-2]", cache=tmp_path)
    assert read.names == ("walk-0.bvh", "walk-1.bvh", "walk-2.bvh")
    expected = corpus(3, frames=80)
    torch.testing.assert_close(read.features, expected.features, atol=1e-5, rtol=1e-5)
    monkeypatch.setattr(corpora, "read_clip_features", None)  # nothing can be read
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
            patch.setattr(f"priors.training.data.{what}", other)
            patch.setattr(corpora, "read_clip_features", None)
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
