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
