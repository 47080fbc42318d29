"""Joint ranges measured over clips: orders, mid poses, percentiles and anatomy."""

import json
import math

import pytest
import torch
from helpers import corpus, generator

from mapctl import joint_ranges, rotations
from mapctl.joint_ranges import JointRanges
from priors.tweening import measure_ranges


def about(axis, degrees):
    vectors = torch.zeros(len(degrees), 3)
    vectors[:, axis] = torch.deg2rad(degrees)
    return rotations.rotation_vector_to_matrix(vectors)


def test_bounds_are_percentiles_with_a_margin_where_there_is_no_anatomy():
    degrees = torch.linspace(-20, 60, 5001)
    found = measure_ranges.measure_joint("leftUpperArm", about(2, degrees), about(2, degrees))
    at = found.order.index("Z")
    assert found.low_deg[at] == pytest.approx(-30, abs=0.2)
    assert found.high_deg[at] == pytest.approx(70, abs=0.2)
    assert found.mid_quat_xyzw == (0.0, 0.0, 0.0, 1.0)


def test_anatomy_widens_what_the_data_does_not_show():
    still = about(0, torch.zeros(1000))
    found = measure_ranges.measure_joint("chest", still, still)
    ends = {axis: (low, high) for axis, low, high in zip(found.order, found.low_deg, found.high_deg, strict=True)}
    assert ends == {"X": (-45, 45), "Y": (-45, 45), "Z": (-30, 30)}


def test_a_knee_bends_one_way_whatever_the_data_says():
    degrees = torch.linspace(-80, 100, 4001)
    found = measure_ranges.measure_joint("leftLowerLeg", about(0, degrees), about(0, degrees))
    at = found.order.index("X")
    assert (found.low_deg[at], found.high_deg[at]) == (-10, 170)
    others = [end for other in {0, 1, 2} - {at} for end in (found.low_deg[other], found.high_deg[other])]
    assert max(map(abs, others)) <= 1.01


def test_only_clips_of_training_make_bounds_and_all_clips_make_the_order():
    train, every = about(2, torch.linspace(-5, 5, 1001)), about(2, torch.linspace(-5, 50, 1001))
    found = measure_ranges.measure_joint("leftUpperArm", every, train)
    assert found.high_deg[found.order.index("Z")] == pytest.approx(15, abs=0.1)


def test_a_mid_pose_is_found_where_no_order_will_do():
    """Rotations whose middle angles reach a right angle in every order about the T-pose."""
    bent = rotations.rotation_vector_to_matrix(0.4 * torch.randn(400, 3, generator=generator()))
    far = rotations.rotation_vector_to_matrix(torch.tensor([[0.5, 1.57, 0.3], [1.57, 0.4, 0.2], [0.2, 0.3, 1.57]]))
    matrices = torch.cat([far @ bent[:, None]]).flatten(0, 1)
    _, about_rest = measure_ranges._choose_order(matrices)
    assert about_rest > measure_ranges.MAX_MIDDLE_DEG
    order, mid = measure_ranges._choose_mid_pose(matrices)
    middle = rotations.to_euler(mid.T @ matrices, rotations.euler_axes([order]))[:, 1]
    assert math.degrees(float(middle.abs().max())) < about_rest - 5
    assert float((mid.T @ mid - torch.eye(3)).abs().max()) < 1e-5


def test_a_whole_table_is_read_as_it_was_measured():
    table = measure_ranges.measure(corpus(6, 90), seed=1)
    ranges = JointRanges.of_joints(joint_ranges.read_table(json.dumps(table)))
    assert table["measured"]["outside_percent"] < 1
    assert table["measured"]["largest_middle_deg"] < 75
    assert table["measured"]["nearest_pose_cm"] < 0.5
    torch.testing.assert_close(
        torch.tensor(measure_ranges.measure_fit(ranges, corpus(6, 90).features)["largest_middle_deg"]),
        torch.tensor(table["measured"]["largest_middle_deg"]),
    )


def test_what_is_outside_is_counted():
    """Ranges of one clip, measured on another that moves more."""
    table = measure_ranges.measure(corpus(6, 90), seed=1)
    ranges = JointRanges.of_joints(joint_ranges.read_table(json.dumps(table)))
    wild = corpus(1, 90).features.clone()
    wild[:, 6:] *= 40
    fit = measure_ranges.measure_fit(ranges, wild)
    assert fit["outside_percent"] > 5
    assert fit["nearest_pose_cm"] > 0.5
