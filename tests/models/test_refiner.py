"""The refiner: what it may change and what it may see, whole or in pieces, and its file."""

from dataclasses import replace

import pytest
import torch
from helpers import generator
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from tiny_refiner import TINY, network_of, refiner_of, walks

import priors
from mapctl.errors import CheckpointError
from mapctl.features import LAYOUT
from priors import checkpoints
from priors import refiner as refiners

BITS = LAYOUT.slices["contacts"]


def clips(frames=40, count=2):
    return torch.stack([clip[:frames] for clip in walks().clips()[:count]]).double()


def with_soft_bits(features):
    soft = features.clone()
    soft[..., BITS] = torch.rand(soft[..., BITS].shape, generator=generator(), dtype=torch.float64)
    return soft


@pytest.mark.parametrize("lookahead", [0, 3])
def test_untrained_it_returns_what_it_was_given_with_hard_bits(lookahead):
    features = with_soft_bits(clips())
    refined = refiner_of(replace(TINY, lookahead=lookahead), trained=False).refine(features)
    torch.testing.assert_close(refined[..., : LAYOUT.continuous], features[..., : LAYOUT.continuous], atol=0, rtol=0)
    assert torch.equal(refined[..., BITS], (features[..., BITS] > 0.5).double())


@pytest.mark.parametrize("limit", [0.1, 2.0])
def test_what_is_added_is_bounded_whatever_the_weights(limit):
    refiner = refiner_of(replace(TINY, limit=limit), scale=1e4)
    features = clips()
    size = LAYOUT.continuous
    change = (refiner.refine(features) - features)[..., :size] / refiner.network.std[:size]
    assert float(change.abs().max()) <= limit * (1 + 1e-9)
    assert float(change.abs().median()) > 0.9 * limit  # these weights ask for far more


def test_a_trained_one_overrules_contact_bits_and_leaves_them_hard():
    features = clips()
    refined = refiner_of(scale=1e4).refine(features)[..., BITS]
    assert set(refined.unique().tolist()) == {0.0, 1.0}
    assert not torch.equal(refined, features[..., BITS])


def test_the_networks_bits_are_probabilities_with_a_slope():
    features = clips().requires_grad_()
    bits = network_of()(features)[0][..., BITS]
    assert bool(((bits > 0) & (bits < 1)).all())
    (slope,) = torch.autograd.grad(bits.sum(), features)
    assert float(slope[..., : LAYOUT.continuous].abs().max()) > 0


@pytest.mark.slow
@given(st.lists(st.integers(0, 13), min_size=1, max_size=12), st.integers(0, 4), st.integers(1, 9))
@settings(max_examples=40)
def test_pieces_of_any_sizes_give_the_whole(sizes, lookahead, piece):
    """Whatever is given at once, and whatever is refined at once."""
    refiner = refiner_of(replace(TINY, lookahead=lookahead))
    features = clips(100).repeat(1, 2, 1)[:, : sum(sizes)]
    pieces = features.split(sizes, dim=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refiners, "_CHUNK_FRAMES", piece)
        streamed = list(refiner.stream(pieces))
    if not features.shape[1]:
        assert streamed == []
        return
    assert all(out.shape[1] <= piece for out in streamed)
    torch.testing.assert_close(torch.cat(streamed, dim=1), refiner.refine(features), atol=1e-9, rtol=0)


@pytest.mark.parametrize("lookahead", [0, 1, 3])
@pytest.mark.parametrize("changed", [1, 20, 39])
def test_a_frame_sees_the_past_and_its_look_ahead_but_nothing_later(changed, lookahead):
    refiner = refiner_of(replace(TINY, lookahead=lookahead))
    features = clips()
    other = features.clone()
    other[:, changed:, LAYOUT.slices["joint_rotations"]] += 0.3
    added = [refiner.refine(motion) - motion for motion in (features, other)]
    difference = (added[0] - added[1])[..., : LAYOUT.continuous].abs().amax((0, 2))
    first = max(0, changed - lookahead)
    assert float(difference[:first].sum()) == pytest.approx(0, abs=1e-12)
    assert float(difference[first:].min()) > 0


@pytest.fixture
def stored(tmp_path):
    """Written as training writes it."""
    refiner = refiner_of(scale=0.1)
    path = tmp_path / "run" / "model.safetensors"
    path.parent.mkdir()
    tensors = {name: value.float() for name, value in refiner.network.state_dict().items()}
    checkpoints.save(tensors, refiner.card, path)
    return path


def test_a_stored_refiner_does_as_before_by_file_or_by_folder(stored):
    features = clips().float()
    expected = refiner_of(scale=0.1).refine(features.double()).float()
    for name in (str(stored), str(stored.parent)):
        loaded = priors.load_refiner(name)
        assert loaded.network.config == TINY
        assert loaded.name == name
        refined = loaded.refine(features)
        torch.testing.assert_close(refined, expected, atol=2e-3, rtol=0)
        assert not refined.requires_grad


def stored_again(path, *, tensors=None, **card):
    before = checkpoints.read_card(path.with_suffix(".json"))
    checkpoints.save(load_file(path) if tensors is None else tensors, replace(before, **card), path)


def test_weights_of_another_kind_or_layout_are_refused(stored):
    stored_again(stored, kind="lstm-gmm")
    with pytest.raises(CheckpointError, match="a lstm-gmm is no refiner"):
        priors.load_refiner(str(stored))
    stored_again(stored, kind="refiner", fingerprint="0" * 12)
    with pytest.raises(CheckpointError, match="its features are"):
        priors.load_refiner(str(stored))
    with pytest.raises(CheckpointError, match="no prior 'nobody'"):
        priors.load_refiner("nobody")
