"""Windows in unfamiliar poses: the motion is as fast as it was, the poses are others, and contacts are of toes that
stay."""

import math

import pytest
import torch
from helpers import corpus, generator

from mapctl import rotations
from mapctl.contacts import ContactSettings
from mapctl.features import LAYOUT, PRIOR_FPS, GroundPose
from mapctl.pose import BodyPose
from mapctl.skeleton import TOE_JOINTS
from priors.training.windows import PoseVariation, vary_features

TURNED = PoseVariation(share=1.0, drift=0.0, tilted=0.0)
TILTED = PoseVariation(share=0.0, tilted=1.0)


def windows():
    return corpus(2, 40).features.unfold(0, 30, 5).transpose(1, 2).contiguous()


def poses(features):
    return BodyPose.of_features(features, GroundPose.origin())


def speeds(features):
    """Angle from frame to frame of each joint but the hips, radians."""
    quats = rotations.from_rotation_vector(poses(features).joint_rotvec)
    return rotations.to_rotation_vector(rotations.multiply(rotations.inverse(quats[:, :-1]), quats[:, 1:])).norm(dim=-1)


def test_joints_turned_by_constants_turn_as_fast_and_the_hips_move_as_before():
    given = windows()
    varied = vary_features(given, TURNED, generator())
    torch.testing.assert_close(speeds(varied), speeds(given), atol=1e-3, rtol=0)
    torch.testing.assert_close(poses(varied).root_position, poses(given).root_position, atol=1e-4, rtol=0)
    assert float((poses(varied).joint_rotvec - poses(given).joint_rotvec).norm(dim=-1).mean()) > math.radians(5)


def test_tilted_bodies_move_rigidly():
    """All joints as far from each other as before, and many hips lower and far from upright."""
    given = windows()
    varied = vary_features(given, TILTED, generator())
    one, other = (poses(each).joints_world() for each in (given, varied))
    torch.testing.assert_close(torch.cdist(one, one), torch.cdist(other, other), atol=2e-3, rtol=0)
    up = rotations.rotate(poses(varied).local_quat_xyzw[:, :, 0], torch.tensor([0.0, 1.0, 0.0]))[..., 1]
    assert float(up.min()) < 0.6
    lowered = (one - other)[..., 0, 1]
    assert float(lowered.max()) > 0.2
    assert float(lowered.min()) > -1e-4


@pytest.mark.parametrize("variation", [TURNED, TILTED, PoseVariation()])
def test_contacts_are_of_toes_that_were_planted_and_still_do_not_travel(variation):
    given = windows()
    varied = vary_features(given, variation, generator())
    before, after = (LAYOUT.pick(each, "contacts") for each in (given, varied))
    assert bool((after <= before).all())
    toes = poses(varied).joints_world()[..., list(TOE_JOINTS), ::2]
    speed = torch.diff(toes, dim=1).norm(dim=-1) * PRIOR_FPS
    assert torch.equal(after[:, 1:] > 0, (before[:, 1:] > 0) & (speed < ContactSettings.slow))
