"""Left and right exchanged on any rig: the picture in a mirror, the rig's own bones, and twice is not at all."""

from dataclasses import replace

import pytest
import torch
from helpers import walk
from rigs_to_edit import RIGS, longer_shin, on_rig, soft_knees

from mapctl import editing, retarget
from mapctl.editing.mirroring import pair_joints
from mapctl.editing.rigged_motion import RiggedMotion
from mapctl.skeleton import CANONICAL, Skeleton

FLIP = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)


def pairs_of(motion) -> dict[str, str | None]:
    rigged = RiggedMotion.of(motion)
    names = motion.skeleton.names
    return {
        name: None if other is None else names[other]
        for name, other in zip(names, pair_joints(rigged.rigmap), strict=True)
    }


@pytest.mark.parametrize("name", RIGS)
def test_twice_is_not_at_all(name):
    motion = on_rig(name)
    again = editing.mirror(editing.mirror(motion))
    torch.testing.assert_close(again.joint_positions(), motion.joint_positions(), atol=1e-9, rtol=0)
    same = (again.local_quat_xyzw * motion.local_quat_xyzw).sum(dim=-1).abs()
    torch.testing.assert_close(same, torch.ones_like(same), atol=1e-9, rtol=0)


def test_fingers_twists_and_middle_joints_are_paired_and_a_sword_is_not():
    pairs = pairs_of(on_rig("fingers, twists, a sword"))
    assert pairs["L_Thumb1_bone"] == "R_Thumb1_bone"
    assert pairs["mixamorig:RightForeArm_twist_01"] == "mixamorig:LeftForeArm_twist_01"
    assert pairs["Middle"] == "Middle"
    assert pairs["Prop_sword"] is None


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("LeftHandThumb1", "RightHandThumb1"),
        ("thumb_01_l", "thumb_01_r"),
        ("lThumb1", "rThumb1"),
        ("Bip01 L Finger0", "Bip01 R Finger0"),
        ("lthumb", "rthumb"),
        ("mixamorig:LeftHandIndex1", "mixamorig:RightHandIndex1"),
    ],
)
def test_names_of_all_kinds_are_paired(left, right):
    names = (*CANONICAL.names, left, right)
    hands = [CANONICAL.index(side + "Hand") for side in ("left", "right")]
    offsets = torch.cat([CANONICAL.offsets, torch.tensor([[0.1, 0, 0.01], [-0.08, 0.02, 0]]).double()])
    skeleton = Skeleton(names, (*CANONICAL.parents, *hands), offsets)
    partners = pair_joints(retarget.identify_rig(skeleton))
    assert partners[-2:] == [len(names) - 1, len(names) - 2]


def test_bones_stay_and_toes_stand_where_they_stood_in_the_mirror():
    motion = longer_shin(soft_knees(walk(60)), 0.004)
    mirrored = editing.mirror(motion)
    assert mirrored.skeleton is motion.skeleton
    toes = [CANONICAL.index(side + "Toes") for side in ("left", "right")]
    before, after = (m.joint_positions()[:, toes] for m in (motion, mirrored))
    assert float((after - before.flip(1) * FLIP).norm(dim=-1).max()) < 0.003
    apart = (editing.mirror(mirrored).joint_positions() - motion.joint_positions()).norm(dim=-1)
    assert float(apart.mean()) < 0.005
    assert float(apart.max()) < 0.05  # knees of straight legs


def test_hips_beside_a_root_joint_that_is_askew_are_where_the_mirror_shows_them():
    motion = on_rig("root on the ground")
    hips, frames = motion.skeleton.index("Hips"), motion.num_frames
    aside = motion.skeleton.offsets[hips] + torch.tensor([0.05, 0.0, 0.02]).double()
    offsets = motion.skeleton.offsets.clone()
    offsets[hips] = aside
    askew = replace(
        motion, skeleton=replace(motion.skeleton, offsets=offsets), moving_offsets={hips: aside.expand(frames, 3)}
    )
    before, after = (m.joint_positions()[:, hips] for m in (askew, editing.mirror(askew)))
    torch.testing.assert_close(after, before * FLIP, atol=1e-9, rtol=0)
