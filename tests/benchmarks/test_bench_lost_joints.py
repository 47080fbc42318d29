"""What infilling is worth where joints are lost throughout: the mean poses that it is compared with, and the rows."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from tiny_infiller import tiny_infiller

from controllers.benchmarks.lost_joints import (
    MISSING_LIMBS,
    average_pose,
    benchmark_missing_joints,
    replace_joint_rotations,
)
from mapctl.skeleton import CANONICAL


def posed(clip, quats):
    """Its way in other poses."""
    return replace(clip, local_quat_xyzw=quats)


def test_the_mean_of_one_pose_is_that_pose_whatever_its_sign():
    clip = walk(5)
    still = clip.local_quat_xyzw[2:3].expand(5, -1, -1) * torch.tensor([1.0, -1, 1, -1, 1])[:, None, None]
    found = average_pose([posed(clip, still)])
    assert ((found * still[0]).sum(-1).abs() - 1).abs().max() < 1e-9


def test_turns_about_one_axis_have_their_middle_as_mean_and_every_clip_counts_alike():
    """Also where one of two clips is longer."""
    clip = walk(12)
    quats = torch.zeros(12, clip.num_joints, 4, dtype=torch.float64)
    angle = torch.tensor([0.3] * 2 + [0.9] * 10, dtype=torch.float64)
    quats[..., 1], quats[..., 3] = torch.sin(angle / 2)[:, None], torch.cos(angle / 2)[:, None]
    found = average_pose([posed(clip, quats).slice(0, 2), posed(clip, quats).slice(2, 12)])
    assert 2 * torch.atan2(found[:, 1].abs(), found[:, 3].abs()) == pytest.approx(0.6, abs=1e-9)


@pytest.mark.parametrize("joints", MISSING_LIMBS.values(), ids=MISSING_LIMBS)
def test_only_the_lost_joints_and_what_hangs_on_them_go_to_a_mean_pose(joints):
    clip = walk(20, seed=1)
    moved = (
        replace_joint_rotations(clip, joints, average_pose([clip])).joint_positions() - clip.joint_positions()
    ).norm(dim=-1)
    lost = [CANONICAL.index(name) for name in joints]
    others = [joint for joint in range(CANONICAL.num_joints) if joint not in lost]
    assert moved[:, lost].mean(dim=0).min() > 1e-3
    assert moved[:, others].max() < 1e-9


@pytest.mark.slow
def test_a_row_for_every_kind_and_limb_and_none_for_clips_that_are_too_short():
    rows = benchmark_missing_joints({"walks": [walk(130), walk(150, seed=3)], "short": [walk(60)]}, tiny_infiller())
    assert [(row["method"], row["clips"]) for row in rows] == [("MAP on walks", 2)] * len(MISSING_LIMBS)
    for row in rows:
        assert row["ratio"] == pytest.approx(row["error_cm"] / row["mean_pose_cm"])
        # A clip's own mean is the best fixed pose in rotations: no other clip's can be much better in places.
        assert 0 < row["own_mean_pose_cm"] < 1.2 * row["mean_pose_cm"]


def test_no_clips_are_no_rows():
    assert benchmark_missing_joints({"walks": []}, tiny_infiller()) == []
