"""Windows of joint positions: those of the motions whose features the corpus holds."""

from fractions import Fraction

import torch
from helpers import corpus, walks
from scipy.spatial.transform import Rotation

from mapctl.features import LAYOUT, GroundPose
from mapctl.inbetweening.missing import MissingMask, interpolate_missing
from mapctl.motion import Motion
from mapctl.pose import decode
from mapctl.skeleton import CANONICAL
from priors.training.windows import PositionWindows

SWAP = CANONICAL.mirror_partners()


def decoded(features):
    return decode(features.double(), GroundPose(torch.zeros(2).double(), torch.zeros(()).double()))


def about_y(angle):
    """Rotations by scipy."""
    return Rotation.from_rotvec(angle.double()[:, None].numpy() * [0.0, 1.0, 0.0])


def without_heading(positions, facing):
    """Places (frames, joints, 3) seen along the headings."""
    return torch.from_numpy(about_y(-facing).as_matrix()[:, None] @ positions.double().numpy()[..., None])[..., 0]


def seen_from_the_root(motion):
    """Joint positions over the hips' ground point, the heading turned away; by scipy."""
    forward = Rotation.from_quat(motion.local_quat_xyzw[:, 0].numpy()).as_matrix()[:, :, 2]
    facing = 2 * torch.atan2(motion.local_quat_xyzw[:, 0, 1], motion.local_quat_xyzw[:, 0, 3])
    assert (torch.from_numpy(forward)[:, 2] * torch.cos(facing) > 0).all()  # upright, so that facing is near enough
    positions = motion.joint_positions() - motion.root_position[:, None] * torch.tensor([1.0, 0.0, 1.0])
    return without_heading(positions, facing)


def test_a_window_is_the_motion_from_that_frame_on():
    data = corpus(3, 60)
    windows = PositionWindows(data, frames=24, evenness=0.0)
    found = windows.at(torch.tensor([1, 2]), torch.tensor([10, 36]), mirrored=torch.tensor([False, False]))
    assert found.present.all()
    for row, (clip, first) in enumerate(((1, 10), (2, 36))):
        features = data.features[60 * clip : 60 * (clip + 1)]
        wanted = decoded(features).joint_positions()[first : first + 24]
        assert (found.positions[row].double() - wanted).norm(dim=-1).max() < 1e-4
        assert torch.equal(found.contacts[row], LAYOUT.pick(features, "contacts")[first : first + 24])
        facing = torch.from_numpy(about_y(found.heading[row]).apply([0.0, 0.0, 1.0]))
        hips = torch.from_numpy(Rotation.from_quat(decoded(features).local_quat_xyzw[:, 0].numpy()).as_matrix())
        assert torch.cosine_similarity(facing[:, ::2], hips[first : first + 24, ::2, 2], dim=1).min() > 0.99


def test_a_mirrored_window_is_the_window_in_a_mirror():
    windows = PositionWindows(corpus(3, 60), frames=30, evenness=0.0)
    clip, first = torch.tensor([0, 2]), torch.tensor([5, 20])
    plain, mirrored = (windows.at(clip, first, mirrored=torch.tensor([side, side])) for side in (False, True))
    flip = torch.tensor([-1.0, 1.0, 1.0])
    assert torch.allclose(mirrored.positions, plain.positions[:, :, SWAP] * flip, atol=1e-5)
    assert torch.allclose(mirrored.heading, -plain.heading)
    assert torch.equal(mirrored.contacts, plain.contacts.flip(-1))
    motion = walks(3, 60)[2].mirror()
    # The walk itself in a mirror, but for where it starts and faces.
    wanted = seen_from_the_root(motion)[20:50]
    local = mirrored.positions[1] - mirrored.positions[1, :, :1] * torch.tensor([1.0, 0.0, 1.0])
    assert (without_heading(local, mirrored.heading[1]) - wanted).norm(dim=-1).max() < 1e-4


def test_the_guess_in_a_gap_is_the_one_that_filling_starts_from():
    """From the rotations of a batch, and of a motion on its rig, bent by the velocities beside the gap, too."""
    windows = PositionWindows(corpus(3, 60), frames=40, evenness=0.0)
    window = windows.at(torch.tensor([1]), torch.tensor([3]), mirrored=torch.tensor([False]))
    known = torch.ones(1, 40, CANONICAL.num_joints, dtype=torch.bool)
    known[:, 10:25] = False
    motion = Motion(CANONICAL, Fraction(30), window.positions[0, :, 0].double(), window.quats[0].double())
    gone = ~known[0, :, 0]
    lost = MissingMask(gone[:, None].expand(-1, CANONICAL.num_joints), gone)
    wanted = interpolate_missing(motion, lost).joint_positions()
    image = window.image(known)
    torch.testing.assert_close(image.to_world(image.positions)[0].double(), wanted, atol=0.05, rtol=0)
