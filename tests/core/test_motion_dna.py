"""Motion DNA: poses apart in time, of any rig, without where the hips are and face."""

from dataclasses import replace

import torch
from captures import on_rig
from helpers import walk

from mapctl import motion_dna, rotations


def test_poses_are_those_of_the_motion_apart_in_time():
    motion = walk(120)
    chosen = motion_dna.choose_frames(motion.local_quat_xyzw, 6)
    assert len(chosen) == 6
    assert int(torch.diff(chosen).min()) >= 15
    dna = motion_dna.of(motion, 6)
    assert dna.poses.shape == (6, 21, 3)
    assert float(dna.poses[:, 0].abs().max()) == 0
    bare = motion.local_quat_xyzw.clone()
    bare[:, 0] = torch.tensor([0.0, 0.0, 0.0, 1.0]).double()
    still = replace(motion, root_position=motion.root_position * 0, local_quat_xyzw=bare)
    torch.testing.assert_close(dna.poses, still.joint_positions()[chosen].float())


def test_where_the_hips_are_and_face_does_not_matter():
    motion = walk(60)
    quats = motion.local_quat_xyzw.clone()
    quats[:, 0] = rotations.multiply(rotations.about_y(torch.tensor(1.0).double()).expand(60, 4), quats[:, 0])
    moved = replace(motion, local_quat_xyzw=quats, root_position=motion.root_position + 7)
    torch.testing.assert_close(motion_dna.of(motion).poses, motion_dna.of(moved).poses)


def test_another_rig_s_poses_are_of_the_canonical_size():
    own, other = (motion_dna.of(on_rig(rig, 60), 4).poses for rig in ("canonical", "daz"))
    assert own.shape == other.shape
    assert float((own - other).norm(dim=-1).max()) < 0.25


def test_a_t_pose_before_a_take_is_none_of_its_poses():
    motion = walk(60)
    first = torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(1, 21, 4)
    quats = torch.cat([first, motion.local_quat_xyzw[1:]])
    taken = motion_dna.of(replace(motion, local_quat_xyzw=quats), 6)
    torch.testing.assert_close(taken.poses, motion_dna.of(motion.slice(1, 60), 6).poses)
