"""The keyframe term: distances from the places that joints are wanted at."""

from dataclasses import replace

import pytest
import torch
from helpers import walking_trial

from mapctl.skeleton import CANONICAL
from mapctl.terms import Keyframe

FRAMES = 6
HAND, FOOT = CANONICAL.index("leftHand"), CANONICAL.index("rightFoot")


@pytest.fixture
def trial():
    return walking_trial(FRAMES)


def beside(trial, *wanted, sigma=0.002):
    """Wants joints so far from where they are: frame, joint and offset."""
    places = trial.joints_world[0].clone()
    mask = torch.zeros(places.shape[:2], dtype=torch.bool)
    for frame, joint, offset in wanted:
        places[frame, joint] += torch.tensor(offset).double()
        mask[frame, joint] = True
    return Keyframe(places, mask, sigma)


def test_the_residual_is_the_distance_and_nothing_where_nothing_is_wanted(trial):
    term = beside(trial, (1, HAND, (0.03, 0.0, 0.04)), (4, FOOT, (0.0, -0.2, 0.0)))
    wanted = torch.tensor([[0.0, 0.05, 0.0, 0.0, 0.2, 0.0]]).double()
    torch.testing.assert_close(term.residual(trial), wanted, atol=1e-7, rtol=0)


def test_the_energy_is_that_of_a_gaussian(trial):
    term = beside(trial, (1, HAND, (0.03, 0.0, 0.04)), sigma=0.01)
    assert float(term(trial)[0, 1]) == pytest.approx(0.5 * 5**2)
    assert float(term(trial).sum()) == pytest.approx(0.5 * 5**2)
    assert float(replace(term, sigma=0.02)(trial).sum()) == pytest.approx(0.5 * 2.5**2)


def test_joints_of_one_frame_add_up_and_the_worst_is_told(trial):
    term = beside(trial, (2, HAND, (0.03, 0.0, 0.0)), (2, FOOT, (0.0, 0.0, 0.01)), sigma=0.01)
    assert float(term(trial)[0, 2]) == pytest.approx(0.5 * (3**2 + 1**2))
    assert float(term.residual(trial)[0, 2]) == pytest.approx(0.03)


def test_what_stands_where_nothing_is_wanted_does_not_matter(trial):
    term = beside(trial, (1, HAND, (0.03, 0.0, 0.04)))
    other = replace(term, places=torch.where(term.wanted[..., None], term.places, 1e3))
    assert torch.equal(term(trial), other(trial))
    assert torch.equal(term.residual(trial), other.residual(trial))
