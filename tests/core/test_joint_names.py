"""Names of joints: canonical ones and the rig's own, in any case; side, part and role by name."""

import pytest
import torch
from helpers import random_motion
from rig_maker import Make, make, names_of
from scenes_walks import walk

from mapctl.errors import RequestError
from mapctl.joint_names import Part, Role, Side, classify_joint, describe_nearest, find_joint
from mapctl.joint_roles import classify_joints, find_feet, find_hips, find_upper_legs
from mapctl.retarget import canonical_joints, rigs
from mapctl.skeleton import Skeleton


def spellings(name):
    return name, name.lower(), name.upper(), name[0].upper() + name[1:]


@pytest.mark.parametrize("preset", [rig.name for rig in rigs.known_rigs()])
def test_every_rig_knows_its_own_and_the_canonical_names_in_any_case(preset):
    names = names_of(preset)
    skeleton = make(Make(names)).skeleton
    known = canonical_joints(random_motion(skeleton, 2))
    for canonical, own in names.items():
        joint = skeleton.names.index(own)
        # Names as the rig writes them come first: the spine of Rigify is its hips.
        as_written = skeleton.names.index(canonical) if canonical in skeleton.names else joint
        assert find_joint(canonical, skeleton.names, lambda: known) == as_written, canonical
        for word in spellings(own):
            # Then canonical ones: Xsens has another LeftShoulder than leftShoulder.
            wanted = joint if word == own else known.get(word, joint)
            assert find_joint(word, skeleton.names, lambda: known) == wanted
        for word in spellings(canonical):
            found = find_joint(word, skeleton.names, lambda: known)
            assert found == joint or skeleton.names[found].lower() == word.lower()


def test_own_names_as_written_come_first():
    names = ("LeftShoulder", "Hand", "hand", "HAND_l")
    known = {"leftShoulder": 3, "leftHand": 1}
    assert find_joint("LeftShoulder", names, lambda: known) == 0
    assert find_joint("leftShoulder", names, lambda: known) == 3
    assert find_joint("leftshoulder", names, lambda: known) == 0
    assert (find_joint("Hand", names), find_joint("hand", names)) == (1, 2)
    assert find_joint("LEFTHAND", names, lambda: known) == 1
    assert find_joint("tail", names, lambda: known) is None
    with pytest.raises(RequestError, match="'HAND' may be Hand and hand; write it as the rig does"):
        find_joint("HAND", names)


def test_the_nearest_names_are_on_the_same_side_and_limb_first():
    names = ("lHand", "lThumb1", "rFoot", "rThumb1", "rHand")
    assert describe_nearest("RightHnad", names) == "the nearest is rHand, then rThumb1 and rFoot"
    assert describe_nearest("lefthand", names) == "the nearest is lHand, then lThumb1 and rHand"


# hips, left and right upper leg, left and right toe; the order in a file varies and is no evidence.
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


HAN = {
    (Side.LEFT, Part.UPPER_LEG): "左大腿 左太もも",
    (Side.RIGHT, Part.LOWER_LEG): "右小腿 右ひざ 右膝",
    (Side.LEFT, Part.FOOT): "左足首 左脚 左脚踝",
    (Side.RIGHT, Part.TOES): "右つま先 右脚趾 右足指",
    (Side.LEFT, Part.UPPER_ARM): "左腕 左上臂 左上腕 腕.L",
    (Side.RIGHT, Part.LOWER_ARM): "右ひじ 右前臂 右前腕 右肘",
    (Side.LEFT, Part.HAND): "左手 左手首 左手腕",
    (Side.RIGHT, Part.FINGER): "右人指１ 右食指",
    (Side.MIDDLE, Part.NECK): "首 脖子",
    (Side.MIDDLE, Part.HEAD): "頭 头",
    (Side.MIDDLE, Part.HIPS): "下半身 骨盆",
    (Side.MIDDLE, Part.TORSO): "上半身 上半身2 腰 胸",
}
"""The same in Chinese and Japanese."""


@pytest.mark.parametrize("table", [NAMES, HAN], ids=["latin", "han"])
def test_role_of_every_way_to_name_it(table):
    for (side, part), names in table.items():
        assert {name: classify_joint(name) for name in names.split()} == dict.fromkeys(names.split(), Role(side, part))


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


@pytest.mark.parametrize(
    ("names", "last"), [(("Neck", "Neck1"), Part.HEAD), (("Neck", "Head"), Part.HEAD), (("Neck",), Part.NECK)]
)
def test_the_last_of_several_neck_joints_is_the_head_of_a_rig_without_one(names, last):
    count = len(names) + 1
    skeleton = Skeleton(("Hips", *names), tuple(range(-1, count - 1)), walk().skeleton.offsets[:count])
    assert [role.part for role in classify_joints(skeleton)][1:] == [*(Part.NECK for _ in names[1:]), last]
