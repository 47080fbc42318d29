"""Body parts by name, over the ways in which rigs name their joints."""

import pytest
from scenes_walks import walk

from mapctl.joint_names import Part, Role, Side, classify_joint
from mapctl.joint_roles import classify_joints
from mapctl.skeleton import CANONICAL, Skeleton, mirror_name

NAMES = {
    (Side.LEFT, Part.UPPER_LEG): "leftUpperLeg LeftUpLeg UpperLeg_L lThigh lfemur mixamorig:LeftUpLeg L_Thigh thigh.L",
    (Side.RIGHT, Part.LOWER_LEG): "rightLowerLeg RightLeg LowerLeg_R rShin rtibia RightKnee Bip01_R_Calf",
    (Side.LEFT, Part.UPPER_ARM): "leftUpperArm LeftArm UpperArm_L lShldr lhumerus upper_arm.L",
    (Side.RIGHT, Part.LOWER_ARM): "rightLowerArm RightForeArm LowerArm_R rForeArm rradius RightElbow",
    (Side.LEFT, Part.SHOULDER): "leftShoulder LeftShoulder Shoulder_L lCollar lclavicle",
    (Side.RIGHT, Part.HAND): "rightHand RightHand Hand_R rHand RightWrist",
    (Side.LEFT, Part.FINGER): "lMid1 lThumb2 LeftHandIndex3 lRing1 leftLittleProximal",
    (Side.RIGHT, Part.TOES): "rightToes RightToeBase Toes_R rtoes",
    (Side.LEFT, Part.FOOT): "leftFoot LeftFoot Foot_L lFoot LeftAnkle",
    (Side.MIDDLE, Part.HIPS): "hips Hips hip pelvis joint_Root mixamorig:Hips",
    (Side.MIDDLE, Part.TORSO): "spine chest Spine1 abdomen LowerBack upperChest",
    (Side.MIDDLE, Part.HEAD): "head Head mixamorig:Head",
    (Side.MIDDLE, Part.NECK): "neck Neck1",
    (Side.MIDDLE, Part.OTHER): "prop tail jaw",
}


@pytest.mark.parametrize(
    ("name", "side", "part"), [(name, *key) for key, names in NAMES.items() for name in names.split()]
)
def test_role_of_every_way_to_name_it(name, side, part):
    assert classify_joint(name) == Role(side, part)


def test_the_other_sides_joint_is_the_same_part_of_the_other_side():
    other = {Side.LEFT: Side.RIGHT, Side.RIGHT: Side.LEFT, Side.MIDDLE: Side.MIDDLE}
    for name in CANONICAL.names:
        assert classify_joint(mirror_name(name)) == Role(other[classify_joint(name).side], classify_joint(name).part)


def test_no_canonical_joint_is_unknown():
    assert Part.OTHER not in {r.part for r in classify_joints(CANONICAL)}


def test_a_shoulder_below_a_collar_is_the_upper_arm_and_a_hip_without_thigh_the_upper_leg():
    names = ("Hips", "LeftHip", "LeftKnee", "Chest", "LeftCollar", "LeftShoulder", "LeftElbow")
    skeleton = Skeleton(names, (-1, 0, 1, 0, 3, 4, 5), walk().skeleton.offsets[:7])
    found = [r.part for r in classify_joints(skeleton)]
    assert found == [
        Part.HIPS,
        Part.UPPER_LEG,
        Part.LOWER_LEG,
        Part.TORSO,
        Part.SHOULDER,
        Part.UPPER_ARM,
        Part.LOWER_ARM,
    ]
