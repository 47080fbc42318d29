"""Euler angles of every order are written continuous over time, also through gimbal lock."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from turns import turn

from mapctl import rotations
from mapctl.formats import bvh
from mapctl.formats import bvh as text

AXES = "XYZ"
EULER_ORDERS = [order for order in product(range(3), repeat=3) if order[0] != order[1] != order[2]]


def written_angles(quat, order, tmp_path):
    """What is written in the three channels of a single joint, degrees."""
    tree = text.Hierarchy(("only",), (-1,), ((0.0,) * 3,), (tuple(AXES[a] + "rotation" for a in order),), {})
    (tmp_path / "in.bvh").write_text(text.compose(tree, "0.01", np.zeros((1, 3)), decimals=6))
    source = bvh.load(tmp_path / "in.bvh")
    root = torch.zeros(len(quat), 3, dtype=torch.float64)
    replace(source, root_position=root, local_quat_xyzw=quat[:, None]).save(tmp_path / "out.bvh")
    return text.read(tmp_path / "out.bvh").values


def euler_quat(degrees, order):
    """Quaternions of angles (frames, 3) by matrices."""
    turns = [turn(order[0], a) @ turn(order[1], b) @ turn(order[2], c) for a, b, c in degrees]
    return rotations.make_sign_continuous(rotations.from_matrix(torch.from_numpy(np.array(turns))))


@pytest.mark.parametrize("order", EULER_ORDERS)
def test_angles_are_written_continuous_through_turns_and_past_the_middle_axis_range(order, tmp_path):
    # The middle angle leaves its principal range on the way, and the outer ones wind up.
    steps = np.linspace(0, 1, 200)[:, None]
    degrees = np.array([10.0, 20.0, -30.0]) + steps * np.array([800.0, 145.0, -500.0])
    assert np.abs(written_angles(euler_quat(degrees, order), order, tmp_path) - degrees).max() < 1e-5


@pytest.mark.parametrize("order", EULER_ORDERS)
def test_gimbal_lock_keeps_the_rotation_and_does_not_jump(order, tmp_path):
    steps = np.linspace(0, 1, 50)
    locked = np.full(50, 0.0 if order[0] == order[2] else 90.0)
    degrees = np.stack([20 + 100 * steps, locked, 40 - 10 * steps], axis=1)
    quat = euler_quat(degrees, order)
    written = written_angles(quat, order, tmp_path)
    assert np.abs(np.diff(written, axis=0)).max() < 3
    assert ((euler_quat(written, order) * quat).sum(-1).abs() > 1 - 1e-12).all()
