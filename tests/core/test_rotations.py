"""Rotation maths against scipy, and its gradients where formulas usually break."""

import math
from itertools import permutations

import numpy as np
import pytest
import torch
from helpers import generator, turn_between
from scipy.spatial.transform import Rotation, Slerp

from mapctl import rotations


def random_quats(count, seed=0):
    return torch.from_numpy(Rotation.random(count, rng=seed).as_quat())


def test_products_actions_and_matrices_are_scipys():
    a, b = random_quats(50, 1), random_quats(50, 2)
    v = torch.randn(50, 3, generator=generator(), dtype=torch.float64)
    ours, theirs = Rotation.from_quat(a), Rotation.from_quat(b)
    assert turn_between(rotations.multiply(a, b), torch.from_numpy((ours * theirs).as_quat())) < 1e-7
    assert turn_between(rotations.inverse(a), torch.from_numpy(ours.inv().as_quat())) < 1e-7
    np.testing.assert_allclose(rotations.rotate(a, v), ours.apply(v.numpy()), atol=1e-12)
    np.testing.assert_allclose(rotations.to_matrix(a), ours.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotations.to_rotation_vector(a), ours.as_rotvec(), atol=1e-9)
    assert turn_between(rotations.from_matrix(rotations.to_matrix(a)), a) < 1e-7
    vectors = torch.from_numpy(ours.as_rotvec())
    np.testing.assert_allclose(rotations.rotation_vector_to_matrix(vectors), ours.as_matrix(), atol=1e-12)
    assert turn_between(rotations.from_rotation_vector(vectors), a) < 1e-7


@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_gradients_of_products_and_matrices_are_differences(shape):
    quats = [torch.from_numpy(Rotation.random(rng=s).as_quat()).expand(*shape, 4).clone() for s in (1, 2)]
    first, second = (quat.requires_grad_(True) for quat in quats)
    vector = torch.randn(*shape, 3, generator=generator(), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotations.multiply, (first, second))
    assert torch.autograd.gradcheck(rotations.rotate, (first, vector))
    assert torch.autograd.gradcheck(lambda q: rotations.from_matrix(rotations.to_matrix(q)), (first,))
    assert torch.autograd.gradcheck(rotations.to_long_rotation_vector, (first,))


def test_split_heading_gives_back_the_rotation_and_a_tilt_without_turn():
    quats = random_quats(200)
    heading, tilt = rotations.split_heading(quats)
    assert turn_between(rotations.multiply(rotations.about_y(heading), tilt), quats) < 1e-7
    assert float(rotations.to_rotation_vector(tilt)[:, 1].abs().max()) < 1e-9
    assert bool(((heading >= -math.pi) & (heading < math.pi)).all())


@pytest.mark.parametrize("start", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0], [0.6, 0, 0.8], [0.36, 0.48, 0.8]])
def test_the_shortest_arc_between_vectors_leads_there_even_to_the_opposite(start):
    start = torch.nn.functional.normalize(torch.tensor(start).double(), dim=0)
    for stop in (-start, start, start.roll(1), torch.nn.functional.normalize(-start + 1e-7 * start.roll(1), dim=0)):
        arc = rotations.between_vectors(2 * start, 3 * stop)
        torch.testing.assert_close(rotations.rotate(arc, start), stop, atol=1e-9, rtol=0)
        angle = float(rotations.to_rotation_vector(arc).norm())
        assert angle == pytest.approx(math.acos(max(-1.0, min(1.0, float(start @ stop)))), abs=1e-6)
    nowhere = rotations.between_vectors(start.new_zeros(2, 3), start.expand(2, 3))
    torch.testing.assert_close(nowhere, start.new_tensor([[0, 0, 0, 1.0]]).expand(2, 4))


def test_sign_continuity_changes_no_rotation_and_leaves_no_jump():
    smooth = rotations.from_rotation_vector(
        torch.linspace(0, 6, 50, dtype=torch.float64)[:, None, None] * torch.ones(1, 2, 3)
    )
    signs = torch.randint(0, 2, (50, 2, 1), generator=generator()) * 2.0 - 1
    fixed = rotations.make_sign_continuous(smooth * signs)
    assert float((fixed[1:] * fixed[:-1]).sum(-1).min()) > 0
    assert turn_between(fixed, smooth) < 1e-7


@pytest.mark.parametrize("weight", [0.0, 0.25, 1.0])
def test_slerp_is_scipys(weight):
    pair = random_quats(2, 7)
    expected = Slerp([0, 1], Rotation.from_quat(pair))([weight]).as_quat()[0]
    got = rotations.slerp(pair[0], -pair[1], torch.tensor(weight, dtype=torch.float64))
    assert turn_between(got, torch.from_numpy(expected)) < 1e-7


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 1.0, math.pi - 1e-4])
def test_gradients_are_exact_at_rest_and_near_a_half_turn(size):
    vector = torch.tensor([0.6, -0.8, 0.0], dtype=torch.float64) * size
    for function in (rotations.from_rotation_vector, rotations.rotation_vector_to_matrix):
        assert torch.autograd.gradcheck(function, vector.clone().requires_grad_(True), eps=1e-7, atol=1e-5)
    if size:  # beyond a half turn the vector flips, so the difference must stay on one side
        back = lambda v: rotations.to_rotation_vector(rotations.from_rotation_vector(v))  # noqa: E731
        assert torch.autograd.gradcheck(back, vector.clone().requires_grad_(True), eps=1e-8, atol=1e-4)


ORDERS = ["".join(order) for order in permutations("XYZ")]


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_are_scipys_intrinsic_ones(order):
    angles = torch.rand(200, 3, generator=generator(), dtype=torch.float64) * 6 - 3
    angles[:, 1] /= 2
    axes, theirs = rotations.euler_axes([order]), Rotation.from_euler(order, angles.numpy())
    np.testing.assert_allclose(rotations.from_euler(angles, axes), theirs.as_matrix(), atol=1e-12)
    matrices = rotations.to_matrix(random_quats(200))
    found = rotations.to_euler(matrices, axes)
    np.testing.assert_allclose(found, Rotation.from_matrix(matrices.numpy()).as_euler(order), atol=1e-9)
    assert float(found[:, 1].abs().max()) <= math.pi / 2
    assert torch.autograd.gradcheck(
        lambda free: rotations.from_euler(free, axes), angles[:5].clone().requires_grad_(True)
    )
    assert torch.autograd.gradcheck(
        lambda vector: rotations.to_euler(rotations.rotation_vector_to_matrix(vector), axes),
        torch.randn(5, 3, generator=generator(1), dtype=torch.float64, requires_grad=True),
    )
