"""Known rigs to canonical joint frames and back, without loss."""

from dataclasses import replace

import pytest
import torch
from helpers import bandai_skeleton, cmu_skeleton, random_motion, turn_between

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.skeleton import CANONICAL, Skeleton

SKELETONS = {"bandai-namco": bandai_skeleton(), "cmu-daz": cmu_skeleton(), "canonical": CANONICAL}
each_rig = pytest.mark.parametrize("rig", SKELETONS)


def random_on(rig, frames=6):
    """Any rotations everywhere, and the hips anywhere, by the root or below it."""
    skeleton = SKELETONS[rig]
    motion = random_motion(skeleton, frames)
    if rig == "bandai-namco":
        return replace(motion, moving_offsets={1: motion.root_position.flip(0)}, source="layout")
    return replace(motion, source="layout")


def read_as_stated(motion):
    """Random rotations show no up axis and no hinges, so the rig is stated."""
    return retarget.to_canonical(motion, retarget.as_rig(retarget.identify_rig(motion.skeleton)))


@each_rig
def test_back_and_there_is_the_canonical_motion(rig):
    rigmap = retarget.identify_rig(SKELETONS[rig])
    wanted = replace(random_motion(rigmap.skeleton, seed=3))
    if rig == "cmu-daz":  # it has no toe joints: the toes cannot turn on their own
        toes = [CANONICAL.index("leftToes"), CANONICAL.index("rightToes")]
        wanted.local_quat_xyzw[:, toes] = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
    canonical, _ = retarget.to_canonical(retarget.from_canonical(wanted, rigmap), retarget.as_rig(rigmap))
    assert turn_between(canonical.local_quat_xyzw, wanted.local_quat_xyzw) < 1e-6
    torch.testing.assert_close(canonical.joint_positions(), wanted.joint_positions(), atol=1e-9, rtol=0)


def test_missing_toes_of_cmu_are_the_feets_end_sites():
    motion = random_motion(cmu_skeleton())
    canonical, rigmap = retarget.to_canonical(motion)
    toe, foot = CANONICAL.index("leftToes"), CANONICAL.index("leftFoot")
    assert rigmap.joint_of[toe] is None
    apart = canonical.joint_positions()[:, toe] - canonical.joint_positions()[:, foot]
    site = torch.tensor(cmu_skeleton().end_offsets["lFoot"], dtype=torch.float64)
    torch.testing.assert_close(apart.norm(dim=-1), site.norm().expand(5), atol=1e-9, rtol=0)
    assert turn_between(canonical.joint_rotations()[:, toe], canonical.joint_rotations()[:, foot]) < 1e-9


def test_joints_beyond_the_canonical_ones_keep_the_originals_rotation_or_rest():
    motion = random_motion(cmu_skeleton())
    canonical, rigmap = retarget.to_canonical(motion)
    thumb = motion.skeleton.index("lThumb1")
    kept = retarget.from_canonical(canonical, rigmap, motion).local_quat_xyzw[:, thumb]
    assert turn_between(kept, motion.local_quat_xyzw[:, thumb]) < 1e-9
    longer = retarget.from_canonical(canonical.join(canonical), rigmap, motion)
    assert turn_between(longer.local_quat_xyzw[:, thumb], torch.tensor([0.0, 0, 0, 1]).double().expand(10, 4)) < 1e-9


def test_the_static_root_of_an_original_stays():
    motion = random_on("bandai-namco")
    canonical, rigmap = read_as_stated(motion)
    moved = retarget.from_canonical(replace(canonical, root_position=canonical.root_position + 1), rigmap, motion)
    torch.testing.assert_close(moved.root_position, motion.root_position)
    hips = motion.joint_positions()[:, 1] + 1
    torch.testing.assert_close(moved.joint_positions()[:, 1], hips, atol=1e-9, rtol=0)


def test_what_is_no_body_is_refused_with_what_is_missing_and_the_known_rigs():
    strange = Skeleton(("bone_1", "bone_2"), (-1, 0), torch.zeros(2, 3).double())
    with pytest.raises(RequestError, match=r"hips, spine.*bone_1, bone_2.*canonical, .*bandai-namco,.* cmu-daz"):
        retarget.identify_rig(strange)
