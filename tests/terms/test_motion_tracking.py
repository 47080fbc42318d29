"""Closeness: nothing for the motion itself wherever it stands, and each sigma's half square for what it is about."""

import pytest
import torch
from helpers import walk

from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.terms import MotionTracking
from mapctl.terms.trial import Trial

TARGET = encode(walk(20, turn_rate=0.3))[0]


def trial(features: torch.Tensor, *, heading: float = 0.0) -> Trial:
    place = GroundPose(torch.tensor([2.0, -1.0]).double(), torch.tensor(heading).double())
    bits = LAYOUT.pick(features, "contacts") > 0.5
    return Trial(features[None], place, contacts=bits[None], before=torch.zeros(0, 21, 3).double())


@pytest.mark.parametrize("heading", [0.0, 2.0, -7.0])
def test_the_motion_itself_costs_nothing_wherever_it_stands(heading):
    term = MotionTracking(TARGET)
    assert float(term(trial(TARGET, heading=heading)).abs().max()) < 1e-12
    assert float(term.residual(trial(TARGET, heading=heading)).max()) < 1e-6


def moved(block: str, by: float, *, column: int = 0) -> torch.Tensor:
    features = TARGET.clone()
    features[:, LAYOUT.slices[block].start + column] += by
    return features


def test_the_way_is_counted_from_the_windows_beginning():
    features = TARGET.clone()
    features[0, LAYOUT.slices["root_displacement_heading"].start] += 0.1  # one side step, kept from then on
    energy = MotionTracking(TARGET, sigma_trajectory=0.2)(trial(features, heading=1.0))
    torch.testing.assert_close(energy[0], torch.full((20,), 0.5 * 0.25).double())


def test_a_pose_costs_the_mean_square_of_its_joints():
    features = moved("joint_rotations", 0.2, column=3 * 9 + 1)
    term = MotionTracking(TARGET, sigma_pose=0.02, effective_joints=5.0)
    made, wanted = (trial(f).joints_world - trial(f).joints_world[:, :, :1] for f in (features, TARGET))
    squares = (made - wanted).square().sum(-1).mean(-1)
    torch.testing.assert_close(term(trial(features)), 0.5 * 5.0 * squares / 0.02**2)
    torch.testing.assert_close(term.residual(trial(features)), squares.sqrt())
    assert float(squares.max()) > 0
