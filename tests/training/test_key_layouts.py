"""Sequences of keys that the generator of long in-betweens is trained on."""

from itertools import pairwise

import pytest
import torch
from helpers import corpus, generator

from mapctl import rotations
from priors.training.recipes.tweener import WHOLE, KeySettings, draw_splices, draw_windows
from priors.training.windows import PoseWindows

SETTINGS = KeySettings(longest=200.0, open_ends=0.0, parts=WHOLE)


@pytest.fixture(scope="module")
def windows():
    return PoseWindows(corpus(6, 150), kinds=(), evenness=1.0)


def gaps_of(known):
    """Last frame of a key, and the first of the next."""
    frames = known.nonzero()[:, 0].tolist()
    return [(one, other) for one, other in pairwise(frames) if other > one + 1]


def draw(windows, seed, progress=1.0, settings=SETTINGS):
    return draw_splices(windows, 3, 700, settings, progress=progress, generator=generator(seed))


def test_gaps_grow_in_the_first_quarter_of_training(windows):
    for progress, most in ((0.0, 30), (0.125, 78), (0.25, 200), (1.0, 200)):
        drawn = [
            draw_windows(windows, 40, 130, SETTINGS, progress=progress, tempo=0.1, generator=generator(seed))
            for seed in range(4)
        ]
        longest = max(stop - start for each in drawn for row in each.known for start, stop in gaps_of(row))
        assert min(most, 130) * 0.6 < longest <= most


def test_windows_have_keys_at_both_ends_and_truth_everywhere(windows):
    drawn = draw_windows(windows, 20, 60, SETTINGS, progress=1.0, tempo=0.1, generator=generator())
    assert bool(drawn.known[:, [0, -1]].all())
    assert bool(drawn.truthful.all())
    assert 4 < int(drawn.mirrored.sum()) < 16


def test_splices_lie_in_gaps_of_three_seconds_and_more(windows):
    found = 0
    for seed in range(5):
        drawn = draw(windows, seed)
        for known, clip, truthful in zip(drawn.known, drawn.clip, drawn.truthful, strict=True):
            spliced = [(start, stop) for start, stop in gaps_of(known) if clip[start] != clip[stop]]
            found += len(spliced)
            assert all(stop - start >= 90 for start, stop in spliced)
            assert not any(bool(truthful[start + 1 : stop].any()) for start, stop in spliced)
            assert bool(truthful[known].all())
    assert found > 15


def test_between_keys_of_one_clip_is_what_its_performer_did(windows):
    drawn = draw(windows, 1)
    ground, heading = drawn.motion.root_position[..., ::2], drawn.motion.heading
    for row in range(3):
        step = torch.diff(ground[row], dim=0).norm(dim=-1)
        turn = rotations.wrap_angle(torch.diff(heading[row])).abs()
        both = drawn.truthful[row, 1:] & drawn.truthful[row, :-1] & (torch.diff(drawn.clip[row]) == 0)
        assert float(step[both].max()) < 0.1
        assert float(turn[both].max()) < 0.3


def test_the_same_generator_draws_the_same(windows):
    one, other = draw(windows, 3), draw(windows, 3)
    assert torch.equal(one.known, other.known)
    assert torch.equal(one.motion.quats, other.motion.quats)
    assert not torch.equal(one.known, draw(windows, 4).known)
