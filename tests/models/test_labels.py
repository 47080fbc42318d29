"""Labels read from clip names, and what a density makes of being told them."""

from dataclasses import replace

import pytest
import torch
from helpers import corpus, generator
from trainable_models import small_settings

from mapctl.errors import RequestError
from mapctl.protocols import DataLimits
from priors.checkpoints import Card
from priors.lstm_gmm import density
from priors.lstm_gmm.density import Labels, LstmGmmDensity
from priors.lstm_gmm.network import LstmGmm, LstmGmmConfig
from priors.training.recipes.lstm_gmm import DensityTrainer, compute_feature_statistics, select_initial_states

CLIPS = ("set_walk_glad_1.bvh", "set_turn-left_glad_2.bvh", "set_turn-right_old_3.bvh", "set_run_old_4.bvh", "odd.bvh")
PATTERN = r"_(?P<gait>walk|run|turn-left|turn-right)_(?P<style>[a-z]+)_"


def test_labels_are_the_named_groups_of_the_clip_names():
    found = density.read_labels(CLIPS, PATTERN)
    assert found.names == ("gait=run", "gait=turn-left", "gait=turn-right", "gait=walk", "style=glad", "style=old")
    held = [{found.names[i] for i in row.nonzero()[:, 0].tolist()} for row in found.held]
    assert held == [
        {"gait=walk", "style=glad"},
        {"gait=turn-left", "style=glad"},
        {"gait=turn-right", "style=old"},
        {"gait=run", "style=old"},
        set(),
    ]
    assert found.groups.tolist() == [[1, 1, 1, 1, 0, 0], [0, 0, 0, 0, 1, 1]]


def test_a_mirrored_turn_is_the_other_turn():
    found = density.read_labels(CLIPS, PATTERN)
    assert [found.names[i] for i in found.mirrored] == [
        "gait=run",
        "gait=turn-right",
        "gait=turn-left",
        "gait=walk",
        "style=glad",
        "style=old",
    ]
    only_left = density.read_labels(CLIPS[:2], PATTERN)
    assert only_left.mirrored == list(range(len(only_left.names)))


def told_network() -> LstmGmm:
    mean, std = compute_feature_statistics(corpus().features)
    torch.manual_seed(0)
    return LstmGmm(LstmGmmConfig(width=8, components=2, labels=("gait=run", "style=old")), mean=mean, std=std)


def test_a_copy_that_was_told_is_the_network_under_that_condition():
    network, inputs = told_network(), torch.randn(1, 6, 68, generator=generator())
    memory = network.start_after(inputs[:, 0])
    condition = torch.tensor([[0.0, 0.0, 1.0]])  # clean; not running; old
    expected, _ = network(inputs, (memory.hidden, memory.cell), condition=condition)
    untold, _ = network(inputs, (memory.hidden, memory.cell))
    old, _ = network.conditioned_on(["style=old"])(inputs, (memory.hidden, memory.cell))
    torch.testing.assert_close(old.mean, expected.mean)
    assert not torch.allclose(untold.mean, expected.mean)
    with pytest.raises(RequestError, match="no label 'style=new', only gait=run, style=old"):
        network.conditioned_on(["style=new"])


def test_half_of_the_windows_are_shown_no_label(tmp_path):
    data = corpus(5)
    known = Labels(("gait=walk", "style=old"), torch.tensor([[1.0, 1.0]] * 5))
    settings = small_settings("lstm-gmm", tmp_path, tmp_path, batch=2000, window=6)
    trainer = DensityTrainer(settings, data, LstmGmmConfig(width=8, components=1, labels=known.names), known)
    _, told = trainer.draw_windows()
    silent = float((told.sum(-1) == 0).double().mean())
    assert pytest.approx(silent, abs=0.04) == 0.5 + 0.5 * 0.09
    assert {tuple(row) for row in told.tolist()} == {(0, 0), (1, 0), (0, 1), (1, 1)}


def labelled_density() -> LstmGmmDensity:
    model, data = told_network(), corpus(4)
    names = ("a_run_old_1", "a_walk_old_2", "a_walk_new_3", "a_run_new_4")
    found = select_initial_states(model, replace(data, names=names), count=4, generator=generator())
    pattern = r"_(?P<gait>run)?(walk)?_(?P<style>old)?"
    card = Card("lstm-gmm", model.config.as_card(), licence="none", data={"labels": pattern}, **Card.layout_fields())
    return LstmGmmDensity("named", model, found, DataLimits(0.5, 1.5, 1.0), card, use_fast=False)


def test_a_told_density_begins_where_the_labels_hold():
    density = labelled_density()
    old_runner = density.conditioned_on(["run", "style=old"])
    assert old_runner.initial_states.names == ("a_run_old_1",)
    assert len(density.conditioned_on(["old"]).initial_states.names) == 2
    assert float(old_runner.initial_states.weight.sum()) == 1
    assert len(density.conditioned_on([]).initial_states.names) == 4
    state, noise = density.initial_states.state.pick(torch.tensor([0])), torch.zeros(1, 3, 66)
    plan = density.plan(state, noise)
    told, untold = (some.rollout(state, noise, plan)[0] for some in (old_runner, density))
    assert not torch.allclose(told, untold)


def test_the_fast_path_is_told_too():
    told = replace(labelled_density().conditioned_on(["old"]), use_fast=True)
    state, noise = told.initial_states.state.pick(torch.tensor([0])), torch.randn(1, 5, 66, generator=generator())
    plan = told.reference.plan(state, noise)
    fast, reference = (engine.rollout(state, noise, plan)[0] for engine in (told, told.reference))
    torch.testing.assert_close(fast, reference, rtol=1e-4, atol=1e-5)


def test_a_density_is_told_what_a_clips_path_tells_of_the_labels_that_it_knows():
    density = labelled_density()
    state, noise = density.initial_states.state.pick(torch.tensor([0])), torch.zeros(1, 3, 66)
    plan = density.plan(state, noise)

    for name, told in (("set/b_run_old_9.bvh", ["run", "old"]), ("set/b_walk_old_9.bvh", ["old"]), ("other.bvh", [])):
        like, on = density.conditioned_like_clip(name), density.conditioned_on(told)
        assert torch.allclose(like.rollout(state, noise, plan)[0], on.rollout(state, noise, plan)[0])
        assert like.initial_states.names == density.initial_states.names
