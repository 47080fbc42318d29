"""What the refiner and its critic see, against positions of the decoded motion and finite differences."""

import pytest
import torch
from helpers import corpus, generator
from scipy.spatial.transform import Rotation

from mapctl.features import LAYOUT, GroundPose
from mapctl.pose import decode
from mapctl.skeleton import CANONICAL
from priors.refiner import compute_end_effectors, count_channels

JOINTS = ("hips", "head", "leftHand", "rightToes")


def clip(frames=40, number=0):
    return corpus().clips()[number][:frames].double()


def by_positions(features, joints, start):
    """From the world positions of the decoded motion; headings by hand, turned back by scipy."""
    motion = decode(features, start)
    index = [CANONICAL.index(name) for name in joints]
    world, root = motion.joint_positions()[:, index].numpy(), motion.root_position.numpy()
    heading = float(start.heading) + LAYOUT.pick(features, "heading_change")[:, 0].cumsum(0).numpy()
    rows = []
    for frame in range(1, len(features)):
        back = Rotation.from_euler("y", -heading[frame])
        ground = root[frame] * [1, 0, 1]
        velocity = 30 * (world[frame] - world[frame - 1])
        rows.append(torch.from_numpy(back.apply([*(world[frame] - ground), *velocity])).flatten())
    return torch.stack(rows)


@pytest.mark.parametrize("number", [0, 1, 4])
def test_they_are_positions_and_velocities_in_the_heading_frame_wherever_the_motion_stands(number):
    features = clip(number=number)
    found = compute_end_effectors(features[None], JOINTS)[0]
    assert found.shape == (39, count_channels(JOINTS))
    for place in (GroundPose.origin(), GroundPose(torch.tensor([3.0, -7.0]), torch.tensor(2.5))):
        torch.testing.assert_close(found, by_positions(features, JOINTS, place), atol=1e-9, rtol=0)


def test_the_fast_path_gives_the_same_in_float32():
    features = torch.stack([clip(number=k) for k in range(5)])
    torch.testing.assert_close(
        compute_end_effectors(features.float(), JOINTS).double(),
        compute_end_effectors(features, JOINTS),
        atol=3e-4,
        rtol=0,
    )


def test_a_frame_depends_on_itself_and_the_one_before_only():
    """And of the one before on its pose alone: that it turned or went on to get there shows nowhere."""
    features = clip()[None]
    found = compute_end_effectors(features, JOINTS)
    torch.testing.assert_close(compute_end_effectors(features[:, 17:19], JOINTS)[0, 0], found[0, 17], atol=1e-9, rtol=0)
    moved = features.clone()
    for block in ("root_displacement_heading", "heading_change"):
        moved[:, 0, LAYOUT.slices[block]] += 0.7
    torch.testing.assert_close(compute_end_effectors(moved, JOINTS), found, atol=1e-9, rtol=0)


def test_the_fast_paths_gradient_is_the_same():
    features = torch.stack([clip(20, number=k) for k in range(3)])
    weight = torch.randn(3, 19, count_channels(JOINTS), generator=generator(1), dtype=torch.float64)
    slopes = []
    for at in (features.clone().requires_grad_(), features.float().requires_grad_()):
        (slope,) = torch.autograd.grad((weight.to(at.dtype) * compute_end_effectors(at, JOINTS)).sum(), at)
        slopes.append(slope.double())
    torch.testing.assert_close(slopes[1], slopes[0], atol=float(1e-4 * slopes[0].abs().max()), rtol=0)
