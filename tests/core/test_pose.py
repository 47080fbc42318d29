"""Body poses: the same body as features, rotations, joint positions and a motion."""

import pytest
import torch
from captures import apart_deg
from helpers import finite_difference, generator, moved, walk

from mapctl.features import LAYOUT, GroundPose, encode
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL, Skeleton

TALL = Skeleton(CANONICAL.names, CANONICAL.parents, 1.3 * CANONICAL.offsets)


@pytest.fixture
def motion():
    """A walk in a bend that begins elsewhere than at the origin and faces away."""
    return moved(walk(40, turn_rate=4.0), turn=2.0, shift=(1.0, -3.0))


def test_of_a_motion_and_back(motion):
    pose = BodyPose.of_motion(motion)
    again = pose.motion(fps=motion.fps)
    assert (again.root_position - motion.root_position).abs().max() < 1e-5
    assert apart_deg(again.local_quat_xyzw.double(), motion.local_quat_xyzw).max() < 0.1
    assert torch.diff(pose.heading).abs().max() < 0.3  # not wrapped, though it turns all the way round


@pytest.mark.parametrize("skeleton", [CANONICAL, TALL])
def test_joint_positions_are_those_of_the_motion(motion, skeleton):
    """The motion's own come from quaternions, these from matrices."""
    pose = BodyPose.of_motion(motion)
    assert (pose.joints_world(skeleton) - pose.motion(skeleton).joint_positions()).abs().max() < 1e-5


def test_features_lead_back_to_the_pose(motion):
    pose = BodyPose.of_motion(motion)
    before = GroundPose(torch.tensor([0.3, 0.4]), torch.tensor(-0.7))
    bits = torch.rand(40, 2, generator=generator()) < 0.5
    features = pose.features(before, bits)
    found = BodyPose.of_features(features, before)
    assert torch.allclose(found.pack(), pose.pack(), atol=1e-4)
    assert torch.equal(LAYOUT.pick(features, "contacts") > 0.5, bits)


def test_features_are_those_of_encode(motion):
    wanted, before = encode(motion)
    single = GroundPose(before.position_xz.float(), before.heading.float())
    found = BodyPose.of_motion(motion).features(single, LAYOUT.pick(wanted, "contacts") > 0.5)
    difference = (found - wanted).abs()
    difference[0, LAYOUT.slices["heading_change"]] %= 2 * torch.pi
    assert difference.max() < 1e-4


def test_gradients_of_joint_positions_are_finite_differences(motion):
    packed = BodyPose.of_motion(motion.slice(0, 4)).pack().double()
    weight = torch.randn(4, CANONICAL.num_joints, 3, generator=generator(1), dtype=torch.float64)
    direction = torch.randn(packed.shape, generator=generator(2), dtype=torch.float64)

    def value(at):
        return (BodyPose.unpack(at).joints_world() * weight).sum()

    at = packed.clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(value(at), at)
    assert float((gradient * direction).sum()) == pytest.approx(finite_difference(value, packed, direction), rel=1e-6)
