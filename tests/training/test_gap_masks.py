"""Gaps as they are cut into training motions."""

from dataclasses import replace

import pytest
import torch
from helpers import generator
from hypothesis import given, settings
from hypothesis import strategies as st

from mapctl.numerics.intervals import true_intervals
from mapctl.skeleton import CANONICAL
from priors.training.recipes.infiller import GapSettings, sample_observation_mask

BATCH, FRAMES = 400, 120
GAPS = GapSettings(keys=0.0, joints=0.0, partial=0.0, several=1)
KEYS = GapSettings(keys=1.0, joints=0.0)
JOINTS = GapSettings(keys=0.0, joints=1.0)


def drawn(recipe, progress=0.0, *, seed=0, frames=FRAMES, present=None):
    present = torch.ones(BATCH, frames, dtype=torch.bool) if present is None else present
    return sample_observation_mask(present, recipe, progress=progress, generator=generator(seed))


def lengths(known):
    """Of all gaps that are whole frames and do not reach a window's end."""
    lost = ~known.any(dim=2)
    return torch.tensor(
        [stop - start for _, start, stop in true_intervals(lost.T) if start > 0 and stop < lost.shape[1]]
    )


def test_a_gap_is_as_long_as_asked_for_and_grows_until_it_is_grown_up():
    recipe = replace(GAPS, spread=2.0)
    means = {progress: float(lengths(drawn(recipe, progress)).float().mean()) for progress in (0.0, 0.25, 0.5, 1.0)}
    assert means[0.0] == pytest.approx(5.0, abs=1.0)
    assert means[0.25] == pytest.approx(32.5, abs=3.0)
    assert means[0.5] == pytest.approx(60.0, abs=4.0)
    assert means[1.0] == pytest.approx(means[0.5], abs=2.0)


def test_the_mean_length_is_told():
    recipe = GapSettings(shortest=10, longest=120, grown=0.3)
    assert [recipe.interpolate_mean_length(progress) for progress in (0.0, 0.15, 0.3, 0.9)] == pytest.approx(
        [10, 65, 120, 120]
    )


def test_of_plain_gaps_all_joints_are_lost_together():
    known = drawn(GAPS, 0.5)
    assert torch.equal(known.all(dim=2), known.any(dim=2))


def test_partly_known_gaps_keep_some_joints():
    partly = drawn(replace(GAPS, partial=1.0), 1.0)
    some = partly.any(dim=2) & ~partly.all(dim=2)
    assert 0.2 < some.any(dim=1).double().mean() <= 1
    none = drawn(replace(GAPS, partial=0.0), 1.0)
    assert not (none.any(dim=2) & ~none.all(dim=2)).any()


def test_lost_joints_are_a_few_throughout_or_for_a_stretch():
    known = drawn(replace(JOINTS, dropout=0.0))
    gone = (~known).any(dim=1).sum(dim=1)
    assert gone.max() <= 4
    assert (gone >= 1).double().mean() > 0.95
    throughout = (~known).all(dim=1).any(dim=1).double().mean()
    assert 0.4 < throughout < 0.9
    assert known.any(dim=2).all()


@pytest.mark.parametrize(("keys", "joints"), [(0.0, 0.3), (0.3, 0.0), (0.2, 0.4)])
def test_windows_are_of_the_three_kinds_by_their_shares(keys, joints):
    known = drawn(GapSettings(keys=keys, joints=joints, partial=0.0, spread=0.0, dropout=0.0, shortest=50, longest=50))
    lost = ~known
    whole = lost.all(dim=2)
    is_joints = lost.any(dim=(1, 2)) & ~whole.any(dim=1)
    is_keys = whole.double().mean(dim=1) > 0.8
    assert is_joints.double().mean() == pytest.approx(joints, abs=0.07)
    assert is_keys.double().mean() == pytest.approx(keys, abs=0.08)


@settings(max_examples=25)
@given(
    st.sampled_from([GapSettings(), GAPS, KEYS, JOINTS]),
    st.floats(0, 1),
    st.integers(0, 999),
    st.sampled_from([32, 50, 160]),
)
def test_no_window_is_without_a_known_frame_and_absent_frames_are_not_known(recipe, progress, seed, frames):
    first = torch.randint(0, frames // 2, (64, 1), generator=generator(seed))
    last = torch.randint(frames // 2 + 1, frames + 1, (64, 1), generator=generator(seed + 1))
    frame = torch.arange(frames)
    present = (frame >= first) & (frame < last)
    known = drawn(recipe, progress, seed=seed, present=present)
    assert known.shape == (64, frames, CANONICAL.num_joints)
    assert known.any(dim=(1, 2)).all()
    assert not known[~present].any()
