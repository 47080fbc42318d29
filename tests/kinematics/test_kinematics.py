"""Forward kinematics against 4x4 matrices, and inverse kinematics, which leads back."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import bandai_skeleton, cmu_skeleton, generator, quat_xyzw, random_motion, walk
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapctl import kinematics, rotations
from mapctl.errors import MapctlError
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Limb, Skeleton, mirror_name

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


@pytest.mark.parametrize("skeleton", [CANONICAL, BRANCHED], ids=["canonical", "branched"])
def test_positions_from_matrices_agree_with_quaternions(skeleton):
    motion = random_motion(skeleton, 6)
    matrices = rotations.to_matrix(motion.local_quat_xyzw).reshape(2, 3, -1, 3, 3)
    positions = kinematics.positions_from_matrices(skeleton, matrices).flatten(0, 1)
    expected = motion.joint_positions() - motion.root_position[:, None]
    torch.testing.assert_close(positions, expected, atol=1e-9, rtol=0)


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
    positions, _ = kinematics.forward_kinematics(
        CANONICAL.offsets, CANONICAL.parents, torch.zeros(3).double(), identity
    )
    at = dict(zip(CANONICAL.names, positions, strict=True))
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


SKELETONS = {"canonical": CANONICAL, "bandai": bandai_skeleton(), "daz": cmu_skeleton()}


def solved(positions, start, skeleton=CANONICAL, **options):
    """The solution as a motion."""
    quats = inverse.solve_inverse_kinematics(positions, start, skeleton, **options)
    root = options.get("root_position", positions[:, 0])
    return Motion(skeleton, walk(2).fps, root, quats)


@settings(max_examples=10)
@given(st.sampled_from(sorted(SKELETONS)), st.integers(0, 10_000))
def test_any_pose_comes_back_from_its_places_whatever_one_starts_from(rig, seed):
    wanted = random_motion(SKELETONS[rig], 4, seed=seed)
    start = random_motion(SKELETONS[rig], 4, seed=seed + 1)
    result = solved(wanted.joint_positions(), start.local_quat_xyzw, SKELETONS[rig])
    assert (result.joint_positions() - wanted.joint_positions()).norm(dim=-1).max() < 1e-9


ARM = Limb(*(CANONICAL.index(f"left{part}") for part in ("UpperArm", "LowerArm", "Hand")), (0, 0, -1))
LEG = Limb(*(CANONICAL.index(f"right{part}") for part in ("UpperLeg", "LowerLeg", "Foot")), (0, 0, 1))


@pytest.mark.parametrize("limb", [ARM, LEG], ids=["arm", "leg"])
@pytest.mark.parametrize("share", [0.7])
def test_a_limb_of_short_bones_that_point_the_wrong_way_bends_as_it_did(limb, share):
    """As the mean of several swings: the end's place is met all the same."""
    motion = walk(40)
    if limb is ARM:  # which hangs straight down there
        quats = motion.local_quat_xyzw.clone()
        quats[:, limb.lower] = quat_xyzw(torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)).expand(40, 4)
        motion = replace(motion, local_quat_xyzw=quats)
    positions = motion.joint_positions()
    shoulder, elbow, hand = positions[:, limb.upper], positions[:, limb.lower], positions[:, limb.end]
    bend = elbow - shoulder - _along(elbow - shoulder, hand - shoulder)
    wrong = positions.clone()
    # The elbow on the other side of the line from the shoulder to the hand, and nearer to it.
    wrong[:, limb.lower] = elbow - (1 + share) * bend
    close = shoulder + 0.8 * (hand - shoulder)
    wrong[:, limb.end] = close
    wrong[:, limb.lower] = close + share * (wrong[:, limb.lower] - close)
    result = solved(wrong, motion.local_quat_xyzw, limbs=(limb,)).joint_positions()
    assert (result[:, limb.end] - close).norm(dim=-1).max() < 1e-9
    now = result[:, limb.lower] - shoulder
    now = now - _along(now, close - shoulder)
    bent = bend.norm(dim=-1) > 0.02
    assert bent.any()
    assert torch.cosine_similarity(now, bend, dim=-1)[bent].min() > 0.5
    without = solved(wrong, motion.local_quat_xyzw).joint_positions()
    assert (without[:, limb.end] - close).norm(dim=-1).max() > 0.01


def _along(vector, axis):
    """The part of a vector along an axis."""
    axis = torch.nn.functional.normalize(axis, dim=-1)
    return (vector * axis).sum(-1, keepdim=True) * axis


def chain(*offsets):
    """A limb of single bones."""
    names = tuple(f"j{number}" for number in range(len(offsets) + 1))
    return Skeleton(names, tuple(range(-1, len(offsets))), torch.tensor([(0.0, 0.0, 0.0), *offsets]).double())


@pytest.mark.parametrize("direction", [(0, -1, 0), (0, 0, -1), (0, 0, 0), (1e-9, -1, 0)])
def test_straight_limbs_and_opposite_directions_give_something_finite(direction):
    limb = chain((0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    aim = torch.tensor(direction).double()
    positions = (torch.arange(4)[:, None] * aim)[None]
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(1, 4, 4)
    result = solved(positions, still, limb)
    assert result.local_quat_xyzw.isfinite().all()
    assert torch.allclose(result.local_quat_xyzw.norm(dim=-1), torch.ones(1, 4).double())
    if aim.any():
        assert torch.allclose(result.joint_positions(), positions, atol=1e-7)
