"""Roles: hips, toes and upper legs of the rigs that people have, by name."""

import pytest
import torch

from mapctl.joint_roles import find_feet, find_hips, find_upper_legs
from mapctl.skeleton import CANONICAL, Skeleton

# hips, left and right upper leg, left and right toe; the order in a file varies and tells nothing.
RIGS = {
    "canonical": "hips leftUpperLeg rightUpperLeg leftToes rightToes",
    "bandai": "Hips UpperLeg_L UpperLeg_R Toes_L Toes_R",
    "mixamo": "mixamorig:* Hips LeftUpLeg RightUpLeg LeftToeBase RightToeBase",
    "mixamo4": "mixamorig4:* Hips LeftUpLeg RightUpLeg LeftToeBase RightToeBase",
    "cmu-daz": "hip lThigh rThigh lFoot rFoot",
    "asf": "root lfemur rfemur ltoes rtoes",
    "lafan": "Hips LeftUpLeg RightUpLeg LeftToe RightToe",
    "biped": "Bip01 * Pelvis L_Thigh R_Thigh L_Toe0 R_Toe0",
    "unreal": "pelvis thigh_l thigh_r ball_l ball_r",
    "vroid": "J_Bip_* C_Hips L_UpperLeg R_UpperLeg L_ToeBase R_ToeBase",
    "rigify": "DEF-* hips thigh.L thigh.R toe.L toe.R",
    "smpl": "Pelvis L_Hip R_Hip L_Foot R_Foot",
    "motionbuilder": "Character1_* Hips LeftUpLeg RightUpLeg LeftToeBase RightToeBase",
}


def joints_of(kind):
    """The five names, with the prefix before `*`."""
    prefix, _, rest = RIGS[kind].rpartition("*")
    return [prefix + name for name in rest.split()]


def rig(names):
    """A skeleton of joints with these names, all under the first."""
    names = tuple(dict.fromkeys(names))
    return Skeleton(names, (-1, *[0] * (len(names) - 1)), torch.zeros(len(names), 3, dtype=torch.float64))


@pytest.mark.parametrize("kind", RIGS)
def test_roles_of_known_rigs(kind):
    names = joints_of(kind)
    skeleton = rig(["Spine", "LeftHand", "RightHand", "LeftToeNub", "Head", *reversed(names)])
    found = (find_hips(skeleton), *find_upper_legs(skeleton), *find_feet(skeleton))
    assert [skeleton.names[joint] for joint in found] == names


def test_toes_go_before_feet():
    skeleton = rig(["Hips", "LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"])
    assert find_feet(skeleton) == (3, 4)
    assert find_feet(CANONICAL) == (CANONICAL.index("leftToes"), CANONICAL.index("rightToes"))


def test_one_toe_alone_is_no_pair():
    skeleton = rig(["Hips", "LeftFoot", "RightFoot", "LeftToeBase"])
    assert find_feet(skeleton) == (1, 2)
