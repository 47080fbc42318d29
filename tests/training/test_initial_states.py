"""Moments that a density begins from, and what its data show to be possible."""

import pytest
import torch
from helpers import corpus, generator

from mapctl.features import LAYOUT, ground_speed
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig
from priors.training.data import Corpus
from priors.training.recipes.lstm_gmm import compute_feature_statistics, measure_data_limits, select_initial_states


def tiny_network() -> LstmGmm:
    mean, std = compute_feature_statistics(corpus().features)
    torch.manual_seed(0)
    return LstmGmm(LstmGmmConfig(width=8, components=2), mean=mean, std=std)


def test_starts_are_the_states_after_stretches_of_clips():
    data = corpus()
    network = tiny_network()
    found = select_initial_states(network, data, count=3, generator=generator())
    assert len(set(found.names)) == 3
    clips = dict(zip(data.names, data.clips(), strict=True))
    for row, name in enumerate(found.names):
        clip = clips[name]
        end = 1 + int((clip == found.state.last_frame[row]).all(-1).nonzero()[0])
        expected = network.advance(network.start_after(clip[:1]), clip[None, 1:end])
        torch.testing.assert_close(found.state.hidden[:, row], expected.hidden[:, 0])
        assert float(found.speed[row]) == pytest.approx(float(ground_speed(clip[end - 30 : end]).mean()), rel=1e-5)


def test_abilities_are_the_speeds_and_turns_of_the_data():
    found = measure_data_limits(corpus())
    speeds = [float(ground_speed(clip).mean()) for clip in corpus().clips()]
    assert min(speeds) * 0.9 < found.slowest < found.fastest < max(speeds) * 1.05
    assert found.turn_rate == pytest.approx(0.3, abs=0.05)
    still = Corpus(("still",), (80,), torch.zeros(80, LAYOUT.size))
    assert measure_data_limits(still).turn_rate == 0


def walks_and_runs() -> tuple[Corpus, torch.Tensor]:
    """Fifteen clips: nine of a kind, five of another, one of a third."""
    walks = corpus(5)
    data = Corpus(
        tuple(f"{kind}_{number}" for kind in "abc" for number in range(5)),
        walks.lengths * 3,
        walks.features.repeat(3, 1),
    )
    kinds = torch.tensor([0] * 9 + [1] * 5 + [2])
    return data, torch.nn.functional.one_hot(kinds).float()


def test_each_combination_of_labels_has_starts_in_proportion_and_none_is_left_out():
    data, labels = walks_and_runs()
    for count, expected in ((3, [1, 1, 1]), (6, [3, 2, 1]), (15, [9, 5, 1]), (40, [9, 5, 1])):
        found = select_initial_states(tiny_network(), data, count=count, generator=generator(), labels=labels)
        kinds = labels[[data.names.index(name) for name in found.names]]
        assert kinds.sum(0).tolist() == expected
        assert (found.weight @ kinds).tolist() == pytest.approx([9 / 15, 5 / 15, 1 / 15])
