"""Between a file's joint frames and those that are aligned with the world at rest."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mapctl.formats.character import RestFrames
from mapctl.formats.parts import NodeTree, UnevenScaleError, chain_matrices
from mapctl.formats.sandbox import Refusal

PARENTS = (-1, 0, 1, 1, 3)
NAMES = ("a", "b", "c", "d", "e")


def random_matrices(random: np.random.Generator, *shape: int, scale: bool = True) -> np.ndarray:
    """Turned, moved and (by default) scaled."""
    turns = Rotation.random(int(np.prod(shape)), rng=random).as_matrix().reshape(*shape, 3, 3)
    matrices = np.zeros((*shape, 4, 4))
    matrices[..., :3, :3] = turns * (random.uniform(0.5, 2.0, (*shape, 1, 1)) if scale else 1.0)
    matrices[..., :3, 3] = random.normal(size=(*shape, 3))
    matrices[..., 3, 3] = 1.0
    return matrices


def example(seed: int):
    """Rest frames of a small tree, local matrices of some frames, and the world matrices they make."""
    random = np.random.default_rng(seed)
    outer, rest = random_matrices(random), random_matrices(random, len(PARENTS))
    frames = RestFrames.of(NAMES, PARENTS, chain_matrices(PARENTS, rest, outer), outer)
    local = np.tile(rest, (6, 1, 1, 1))
    turned = random_matrices(random, 6, len(PARENTS), scale=False)
    local[..., :3, :3] = local[..., :3, :3] @ turned[..., :3, :3]
    local[:, 0, :3, 3] += random.normal(size=(6, 3))
    return frames, local, chain_matrices(PARENTS, local, outer)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_joints_are_where_the_file_has_them(seed):
    frames, _, worlds = example(seed)
    motion = frames.to_motion(worlds, Fraction(30), frames.skeleton({}), None)
    np.testing.assert_allclose(motion.joint_positions().numpy(), worlds[..., :3, 3], atol=1e-9)
    assert motion.moving_offsets == {}


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_locals_come_back(seed):
    frames, local, worlds = example(seed)
    moved, turned = frames.to_locals(frames.to_motion(worlds, Fraction(30), frames.skeleton({}), None))
    np.testing.assert_allclose(moved, local[..., :3, 3], atol=1e-9)
    scale = np.linalg.norm(local[..., :3, 0], axis=-1)[..., None, None]
    np.testing.assert_allclose(
        Rotation.from_quat(turned.reshape(-1, 4)).as_matrix().reshape(local[..., :3, :3].shape),
        local[..., :3, :3] / scale,
        atol=1e-9,
    )


def test_a_joint_that_moves_within_its_parent_is_kept():
    frames, local, _ = example(5)
    local = local.copy()
    local[2:, 3, :3, 3] += 0.1
    worlds = chain_matrices(PARENTS, local, frames.outer)
    motion = frames.to_motion(worlds, Fraction(30), frames.skeleton({}), None)
    assert set(motion.moving_offsets) == {3}
    np.testing.assert_allclose(motion.joint_positions().numpy(), worlds[..., :3, 3], atol=1e-9)
    np.testing.assert_allclose(frames.to_locals(motion)[0], local[..., :3, 3], atol=1e-9)


@pytest.mark.parametrize(
    ("linear", "why"),
    [
        (np.diag([1.0, 1.0, 1.1]), "not the same along all axes"),
        (np.diag([1.0, 1.0, -1.0]), "negative"),
        (np.zeros((3, 3)), "zero"),
        (np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "not the same along all axes"),
    ],
)
def test_uneven_scale_is_reported_with_its_joint(linear, why):
    worlds = np.tile(np.eye(4), (3, 1, 1))
    worlds[1, :3, :3] = linear
    with pytest.raises(UnevenScaleError, match=f"joint b: .*{why}"):
        RestFrames.of(("a", "b", "c"), (-1, 0, 1), worlds, np.eye(4))


@pytest.mark.parametrize("mirror", [(-1, -1, -1), (1, 1, -1), (-0.5, 0.5, 0.5)])
def test_a_last_joint_may_mirror(mirror):
    """Its scale does not change how it turns, and takes its mesh along."""
    frames, _, worlds = example(3)
    scaled = np.diag([*mirror, 1.0])
    rest, moved = frames.matrices(), worlds.copy()
    rest[4], moved[:, 4] = rest[4] @ scaled, moved[:, 4] @ scaled
    found = RestFrames.of(NAMES, PARENTS, rest, frames.outer)
    np.testing.assert_allclose(found.matrices(), rest, atol=1e-12)
    given, wanted = (f.to_motion(w, Fraction(30), f.skeleton({}), None) for f, w in ((found, moved), (frames, worlds)))
    np.testing.assert_allclose(given.joint_positions(), wanted.joint_positions(), atol=1e-12)
    same = (given.joint_rotations() * wanted.joint_rotations()).sum(-1).abs()
    np.testing.assert_allclose(same, 1.0, atol=1e-12)


def test_nodes_between_joints_are_joints():
    tree = NodeTree({0: [1, 4], 1: [2], 2: [3], 3: [], 4: []})
    assert tree.connect([3, 1]) == [1, 2, 3]
    assert tree.connect([4, 3]) == [0, 1, 2, 3, 4]
    for children, fault in (({0: [2], 1: [2], 2: []}, "two parents"), ({0: [1], 1: [0]}, "below itself")):
        with pytest.raises(Refusal, match=fault):
            NodeTree(children).line(0)
