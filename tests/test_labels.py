"""Labels read from clip names, and what a density makes of being told them."""

import pytest
import torch
from helpers import corpus, generator

from mapctl.errors import RequestError
from priors.lstm_gmm import LstmGmm, LstmGmmConfig
from priors.training import labels
from priors.training.labels import Labels
from priors.training.lstm_gmm import Trainer, TrainingSettings, statistics
from priors.training.matching import MatchingSettings

CLIPS = ("set_walk_glad_1.bvh", "set_turn-left_glad_2.bvh", "set_turn-right_old_3.bvh", "set_run_old_4.bvh", "odd.bvh")
PATTERN = r"_(?P<gait>walk|run|turn-left|turn-right)_(?P<style>[a-z]+)_"


def test_labels_are_the_named_groups_of_the_clip_names():
    found = labels.read(CLIPS, PATTERN)
    assert found.names == ("gait=run", "gait=turn-left", "gait=turn-right", "gait=walk", "style=glad", "style=old")
    held = [{found.names[i] for i in row.nonzero()[:, 0].tolist()} for row in found.held]
    assert held == [{"gait=walk", "style=glad"}, {"gait=turn-left", "style=glad"}, {"gait=turn-right", "style=old"},
                    {"gait=run", "style=old"}, set()]  # fmt: skip
    assert found.groups.tolist() == [[1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1]]


def test_a_mirrored_turn_is_the_other_turn():
    found = labels.read(CLIPS, PATTERN)
    assert [found.names[i] for i in found.mirrored] == [
        "gait=run", "gait=turn-right", "gait=turn-left", "gait=walk", "style=glad", "style=old",
    ]  # fmt: skip
    only_left = labels.read(CLIPS[:2], PATTERN)
    assert only_left.mirrored == list(range(len(only_left.names)))


@pytest.mark.parametrize(("pattern", "message"), [("(", "regular expression"), ("walk", "named groups"),
                                                  ("(?P<gait>swim)", "match no clip")])  # fmt: skip
def test_patterns_that_read_nothing_are_refused(pattern, message):
    with pytest.raises(RequestError, match=message):
        labels.read(CLIPS, pattern)


def test_labels_renamed_keep_what_both_know():
    renamed = labels.read(CLIPS, PATTERN).renamed(("style=old", "style=new"))
    assert renamed.held.tolist() == [[0, 0], [0, 0], [1, 0], [1, 0], [0, 0]]


def told_network() -> LstmGmm:
    mean, std = statistics(corpus().features)
    torch.manual_seed(0)
    return LstmGmm(LstmGmmConfig(width=8, components=2, labels=("gait=run", "style=old")), mean=mean, std=std)


def test_a_copy_that_was_told_is_the_network_under_that_condition():
    network, inputs = told_network(), torch.randn(1, 6, 68, generator=generator())
    memory = network.initial_state(inputs[:, 0])
    condition = torch.tensor([[0.0, 0.0, 1.0]])  # clean; not running; old
    expected, _ = network(inputs, (memory.hidden, memory.cell), condition=condition)
    untold, _ = network(inputs, (memory.hidden, memory.cell))
    old, _ = network.told(["style=old"])(inputs, (memory.hidden, memory.cell))
    torch.testing.assert_close(old.mean, expected.mean)
    assert not torch.allclose(untold.mean, expected.mean)
    with pytest.raises(RequestError, match="no label 'style=new', only gait=run, style=old"):
        network.told(["style=new"])


def test_half_of_the_windows_are_told_nothing_and_none_more_than_is_known():
    data = corpus(5)
    known = Labels(("gait=walk", "style=old"), torch.tensor([[1.0, 1.0]] * 5))
    settings = TrainingSettings(steps=1, batch=2000, window=6, matching=MatchingSettings(begin=1.0))
    trainer = Trainer(LstmGmmConfig(width=8, components=1, labels=known.names), settings, data, labels=known)
    _, told = trainer._windows()
    silent = float((told.sum(-1) == 0).double().mean())
    assert pytest.approx(silent, abs=0.04) == 0.5 + 0.5 * 0.09
    assert {tuple(row) for row in told.tolist()} == {(0, 0), (1, 0), (0, 1), (1, 1)}
