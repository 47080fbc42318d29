"""Forward kinematics against 4x4 matrices multiplied joint by joint."""

import math

import numpy as np
import pytest
import torch
from helpers import finite_difference, generator, quat_xyzw, random_motion, turn_between
from scipy.spatial.transform import Rotation

from mapctl import kinematics, rotations
from mapctl.errors import MapctlError
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

BRANCHED = Skeleton(
    ("a", "b", "c", "d", "e"), (-1, 0, 0, 1, 3), torch.randn(5, 3, generator=generator(1), dtype=torch.float64)
)


def by_matrices(skeleton, root, local):
    """World transforms of one frame as 4x4 matrices."""
    world = []
    for joint, parent in enumerate(skeleton.parents):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_quat(local[joint]).as_matrix()
        step[:3, 3] = root if parent < 0 else skeleton.offsets[joint]
        world.append(step if parent < 0 else world[parent] @ step)
    return np.stack(world)


@pytest.mark.parametrize("skeleton", [CANONICAL, BRANCHED], ids=["canonical", "branched"])
def test_positions_and_rotations_are_the_product_of_transforms(skeleton):
    motion = random_motion(skeleton, 3)
    for frame in range(3):
        world = by_matrices(skeleton, motion.root_position[frame], motion.local_quat_xyzw[frame])
        np.testing.assert_allclose(motion.joint_positions()[frame], world[:, :3, 3], atol=1e-9)
        np.testing.assert_allclose(rotations.to_matrix(motion.joint_rotations()[frame]), world[:, :3, :3], atol=1e-9)


def test_local_rotations_come_back_from_the_world():
    motion = random_motion(CANONICAL)
    local = kinematics.local_from_world(CANONICAL.parents, motion.joint_rotations())
    assert turn_between(local, motion.local_quat_xyzw) < 1e-7


@pytest.mark.parametrize("skeleton", [CANONICAL, BRANCHED], ids=["canonical", "branched"])
def test_positions_from_matrices_agree_with_quaternions(skeleton):
    motion = random_motion(skeleton, 6)
    matrices = rotations.to_matrix(motion.local_quat_xyzw).reshape(2, 3, -1, 3, 3)
    places = kinematics.positions_from_matrices(skeleton, matrices).flatten(0, 1)
    expected = motion.joint_positions() - motion.root_position[:, None]
    torch.testing.assert_close(places, expected, atol=1e-9, rtol=0)


def test_gradient_of_a_toe_is_that_of_finite_differences():
    vectors = 0.4 * torch.randn(CANONICAL.num_joints, 3, generator=generator(), dtype=torch.float64)
    weight = torch.randn(CANONICAL.num_joints, 3, generator=generator(1), dtype=torch.float64)

    def measure(v):
        local = rotations.from_rotation_vector(v)
        places, _ = kinematics.forward_kinematics(CANONICAL.offsets, CANONICAL.parents, v[0], local)
        return (places * weight).sum()

    direction = torch.randn(vectors.shape, generator=generator(2), dtype=torch.float64)
    leaf = vectors.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(measure(leaf), leaf)
    assert math.isclose(
        float((gradient * direction).sum()), finite_difference(measure, vectors, direction), rel_tol=1e-6
    )


@pytest.mark.parametrize("degrees", [45, -135])
def test_heading_is_the_direction_that_the_hips_face(degrees):
    angle = math.radians(degrees)
    turn, lean = quat_xyzw(torch.tensor([[0, angle, 0], [0.2, 0, -0.1]], dtype=torch.float64))
    heading = kinematics.heading(rotations.multiply(turn, lean))
    assert math.isclose(float(heading), angle, abs_tol=1e-9)
    facing = rotations.rotate(turn, torch.tensor([0.0, 0, 1]).double())
    assert math.isclose(math.atan2(float(facing[0]), float(facing[2])), float(heading), abs_tol=1e-9)


def test_the_canonical_skeleton_stands_as_the_conventions_say():
    identity = torch.tensor([0.0, 0, 0, 1]).double().expand(CANONICAL.num_joints, 4)
    places, _ = kinematics.forward_kinematics(CANONICAL.offsets, CANONICAL.parents, torch.zeros(3).double(), identity)
    at = dict(zip(CANONICAL.names, places, strict=True))
    assert CANONICAL.num_joints == 21
    assert at["leftHand"][0] > 0.5 > -0.5 > at["rightHand"][0]
    assert at["leftToes"][2] > at["leftFoot"][2]
    assert at["head"][1] > at["hips"][1] > at["leftLowerLeg"][1] > at["leftFoot"][1]
    for name in CANONICAL.names:
        torch.testing.assert_close(at[mirror_name(name)] * torch.tensor([-1.0, 1, 1]), at[name], check_dtype=False)


@pytest.mark.parametrize(
    ("names", "parents", "rows"),
    [
        (("a", "a"), (-1, 0), 2),
        (("a", "b"), (-1, 1), 2),
        (("a", "b"), (0, 0), 2),
        (("a", "b"), (-1, 0), 3),
        (("a", "b", "c"), (-1, -1, 0), 3),
    ],
)
def test_trees_that_are_none_are_refused(names, parents, rows):
    with pytest.raises(MapctlError):
        Skeleton(names, parents, torch.zeros(rows, 3, dtype=torch.float64))
