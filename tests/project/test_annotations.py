"""What a signature says is held to while tests run: shapes by jaxtyping, all else by beartype (see conftest.py)."""

import pytest
import torch
from jaxtyping import TypeCheckError

from mapctl import rotations
from mapctl.joint_roles import find_hips
from mapctl.numerics import gaussian


def test_shapes_are_checked():
    with pytest.raises(TypeCheckError, match="vector_xz"):
        rotations.rotate_ground(torch.zeros(5, 3), torch.zeros(5))


def test_dimensions_of_one_name_are_as_long():
    with pytest.raises(TypeCheckError, match="angle"):
        rotations.rotate_ground(torch.zeros(5, 2), torch.zeros(4))


def test_types_are_checked_with_shapes_and_without():
    with pytest.raises(TypeCheckError, match="sigma"):
        gaussian.kernel("wide", 3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(TypeCheckError, match="skeleton"):
        find_hips("hips")  # pyright: ignore[reportArgumentType]
