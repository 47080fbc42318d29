"""Range-constrained forward kinematics: poses from any numbers, and their gradients."""

import pytest
import torch
from helpers import generator

from mapctl import joint_ranges, kinematics, rotations
from mapctl.skeleton import CANONICAL
from priors.tweener import POSE_ROWS, RangeConstrainedKinematics


@pytest.fixture
def layer():
    return RangeConstrainedKinematics().double()


def rows(*shape, spread=1.0, seed=0):
    return spread * torch.randn(*shape, POSE_ROWS, generator=generator(seed), dtype=torch.float64)


@pytest.mark.parametrize("spread", [0.1, 1.0, 50.0])
def test_whatever_goes_in_a_body_within_its_ranges_comes_out(layer, spread):
    pose = layer(rows(2, 7, spread=spread))
    angles = joint_ranges.load().to_angles(pose.local_matrix[..., 1:, :, :])
    assert float(joint_ranges.load().find_excess(angles).max()) < 1e-5
    unit = pose.local_matrix.mT @ pose.local_matrix
    torch.testing.assert_close(unit, torch.eye(3).double().expand_as(unit), atol=1e-5, rtol=0)
    lengths = (pose.places[..., 1:, :] - pose.places[..., list(CANONICAL.parents[1:]), :]).norm(dim=-1)
    torch.testing.assert_close(lengths, CANONICAL.offsets[1:].norm(dim=-1).expand_as(lengths), atol=1e-6, rtol=0)


def test_places_are_those_of_the_forward_kinematics_of_quaternions(layer):
    pose = layer(rows(5))
    quats = rotations.from_matrix(pose.local_matrix)
    places, _ = kinematics.forward_kinematics(
        CANONICAL.offsets, CANONICAL.parents, torch.zeros(5, 3, dtype=torch.float64), quats
    )
    torch.testing.assert_close(pose.places, places, atol=1e-6, rtol=0)


def test_the_hips_turn_freely(layer):
    wanted = rotations.to_matrix(
        rotations.from_rotation_vector(torch.tensor([[2.0, -1.0, 1.5], [0.0, 3.1, 0.0]], dtype=torch.float64))
    )
    given = rows(2)
    given[:, :6] = rotations.to_six(wanted)
    torch.testing.assert_close(layer(given).local_matrix[:, 0], wanted, atol=1e-12, rtol=0)
