"""Features and body poses: invertible, free of place and heading, mirrored and reversed; motion DNA."""

from dataclasses import replace

import pytest
import torch
from captures import apart_deg
from helpers import moved, random_motion, walk

from mapctl import motion_dna, rotations
from mapctl.errors import MapctlError
from mapctl.features import LAYOUT, GroundPose, encode, mirror_features, reversed_features
from mapctl.motion import Motion
from mapctl.pose import BodyPose, decode
from mapctl.skeleton import CANONICAL, Skeleton

MOTIONS = {"walk": walk(40, turn_rate=1.0), "anything": random_motion(CANONICAL, 30)}
each_motion = pytest.mark.parametrize("kind", MOTIONS)


@each_motion
def test_decoding_gives_the_motion_back(kind):
    motion = MOTIONS[kind]
    back = decode(*encode(motion))
    torch.testing.assert_close(back.root_position, motion.root_position, atol=1e-9, rtol=0)
    torch.testing.assert_close(back.joint_positions(), motion.joint_positions(), atol=1e-8, rtol=0)
    dots = (back.local_quat_xyzw * motion.local_quat_xyzw).sum(-1).abs()
    torch.testing.assert_close(dots, torch.ones_like(dots), atol=1e-9, rtol=0)


@each_motion
@pytest.mark.parametrize("turn", [3.0])
def test_features_know_neither_place_nor_heading(kind, turn):
    motion = MOTIONS[kind]
    here, start = encode(motion)
    there, position = encode(moved(motion, turn=turn, shift=(5.0, -3.0)))
    torch.testing.assert_close(there, here, atol=1e-9, rtol=0)
    assert float(rotations.wrap_angle(position.heading - start.heading - turn).abs()) < 1e-9


@each_motion
def test_mirrored_features_are_those_of_the_mirrored_motion(kind):
    motion = MOTIONS[kind]
    torch.testing.assert_close(mirror_features(encode(motion)[0]), encode(motion.mirror())[0], atol=1e-9, rtol=0)
    torch.testing.assert_close(mirror_features(mirror_features(encode(motion)[0])), encode(motion)[0])


def test_motions_that_have_no_features_are_refused():
    with pytest.raises(MapctlError, match="at least two frames"):
        encode(walk(1))
    renamed = replace(CANONICAL, names=("pelvis", *CANONICAL.names[1:]))
    with pytest.raises(MapctlError, match="canonical motion"):
        encode(Motion(renamed, *(getattr(walk(3), f) for f in ("fps", "root_position", "local_quat_xyzw"))))


WALKS = {
    "left": walk(90, turn_rate=0.9),
    "over the wrap": walk(120, turn_rate=2.5),
    "two frames": walk(40, turn_rate=0.9).slice(20, 22),
}
each_walk = pytest.mark.parametrize("kind", WALKS)


def backwards(motion):
    """The motion played from its end."""
    return replace(motion, root_position=motion.root_position.flip(0), local_quat_xyzw=motion.local_quat_xyzw.flip(0))


@each_walk
def test_they_are_the_features_of_the_motion_run_backwards(kind):
    there, back = (encode(motion)[0] for motion in (WALKS[kind], backwards(WALKS[kind])))
    torch.testing.assert_close(reversed_features(there), back, atol=1e-9, rtol=0)
    if len(there) > 2:
        assert float((reversed_features(there) - there.flip(0)).abs().max()) > 0.01  # not merely the frames in reverse


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


def test_features_are_those_of_encode(motion):
    wanted, before = encode(motion)
    single = GroundPose(before.position_xz.float(), before.heading.float())
    found = BodyPose.of_motion(motion).features(single, LAYOUT.pick(wanted, "contacts") > 0.5)
    difference = (found - wanted).abs()
    difference[0, LAYOUT.slices["heading_change"]] %= 2 * torch.pi
    assert difference.max() < 1e-4


def test_poses_are_those_of_the_motion_apart_in_time():
    motion = walk(120)
    chosen = motion_dna.choose_frames(motion.local_quat_xyzw, 6)
    assert len(chosen) == 6
    assert int(torch.diff(chosen).min()) >= 15
    dna = motion_dna.of(motion, 6)
    assert dna.shape == (6, 21, 3)
    assert float(dna[:, 0].abs().max()) == 0
    bare = motion.local_quat_xyzw.clone()
    bare[:, 0] = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    still = replace(motion, root_position=motion.root_position * 0, local_quat_xyzw=bare)
    torch.testing.assert_close(dna, still.joint_positions()[chosen].float())


def test_a_t_pose_before_a_take_is_none_of_its_poses():
    motion = walk(60)
    first = torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(1, 21, 4)
    quats = torch.cat([first, motion.local_quat_xyzw[1:]])
    taken = motion_dna.of(replace(motion, local_quat_xyzw=quats), 6)
    torch.testing.assert_close(taken, motion_dna.of(motion.slice(1, 60), 6))
