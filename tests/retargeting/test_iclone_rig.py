"""Rigs of iClone and Character Creator, as their files are: a pelvis beside the spine, twist and share bones."""

import numpy as np
import pytest
import torch
from helpers import random_motion, turn_between
from rig_maker import names_of, person

import mapctl
from mapctl import retarget
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton

_BONES = {
    side: {
        "Clavicle": "Shoulder",
        "Upperarm": "UpperArm",
        "Forearm": "LowerArm",
        "Hand": "Hand",
        "Thigh": "UpperLeg",
        "Calf": "LowerLeg",
        "Foot": "Foot",
        "ToeBase": "Toes",
    }
    for side in ("left", "right")
}
TWISTED = {"Upperarm": "Forearm", "Forearm": "Hand", "Thigh": "Calf", "Calf": "Foot"}


def tree():
    """Name, parent and place in the T-pose (canonical body, metres) of every joint, parents first."""
    place = torch.zeros(CANONICAL.num_joints, 3, dtype=torch.float64)
    for joint, parent in enumerate(CANONICAL.parents[1:], start=1):
        place[joint] = place[parent] + CANONICAL.offsets[joint]
    at = {name: place[joint] for joint, name in enumerate(CANONICAL.names)}
    up = torch.tensor([0.0, 0.03, 0.0], dtype=torch.float64)
    yield "RL_BoneRoot", "", at["hips"] * 0
    yield "CC_Base_Hip", "RL_BoneRoot", at["hips"]
    yield "CC_Base_Pelvis", "CC_Base_Hip", at["hips"]
    yield "CC_Base_Waist", "CC_Base_Hip", at["spine"]
    yield "CC_Base_Spine01", "CC_Base_Waist", (at["spine"] + at["chest"]) / 2
    yield "CC_Base_Spine02", "CC_Base_Spine01", at["chest"]
    yield "CC_Base_NeckTwist01", "CC_Base_Spine02", at["neck"]
    yield "CC_Base_NeckTwist02", "CC_Base_NeckTwist01", (at["neck"] + at["head"]) / 2
    yield "CC_Base_Head", "CC_Base_NeckTwist02", at["head"]
    yield "CC_Base_FacialBone", "CC_Base_Head", at["head"] + up
    yield "CC_Base_JawRoot", "CC_Base_FacialBone", at["head"] + up
    for side, mark in (("left", "L"), ("right", "R")):
        yield from sided(side, f"CC_Base_{mark}_", at)
        yield f"CC_Base_{mark}_Eye", "CC_Base_FacialBone", at["head"] + 2 * up
        yield f"CC_Base_{mark}_RibsTwist", "CC_Base_Spine02", at["chest"] + up
        yield f"CC_Base_{mark}_Breast", f"CC_Base_{mark}_RibsTwist", at["chest"] + 2 * up


def sided(side, own, at):
    """One arm and one leg; in files the twist bones come before the limb that goes on."""
    limbs = (("Clavicle", "Upperarm", "Forearm", "Hand"), ("Thigh", "Calf", "Foot", "ToeBase"))
    for above, limb in zip(("CC_Base_Spine02", "CC_Base_Pelvis"), limbs, strict=True):
        for bone in limb:
            here = at[side + _BONES[side][bone]]
            yield own + bone, above, here
            above = own + bone
            if bone in TWISTED:
                there = at[side + _BONES[side][TWISTED[bone]]]
                yield f"{own}{bone}Twist01", above, here + (there - here) / 3
                yield f"{own}{bone}Twist02", f"{own}{bone}Twist01", here + 2 * (there - here) / 3
            if bone in ("Forearm", "Calf"):
                yield f"{own}{'Elbow' if bone == 'Forearm' else 'Knee'}ShareBone", above, here
        for finger in ("Thumb", "Index", "Mid", "Ring", "Pinky") if limb[-1] == "Hand" else ("BigToe", "PinkyToe"):
            tip = at[side + _BONES[side][limb[-1]]]
            for number in (1, 2):
                tip = tip + 0.02 * torch.tensor([1.0 if side == "left" else -1.0, 0.0, 0.5], dtype=torch.float64)
                yield f"{own}{finger}{number}", above if number == 1 else f"{own}{finger}1", tip


def skeleton(root="RL_BoneRoot", skinny=False):
    """All of it; `skinny` without the bones that only bend the skin."""
    joints = [(root if n == "RL_BoneRoot" else n, root if p == "RL_BoneRoot" else p, at) for n, p, at in tree()]
    joints = [joint for joint in joints if not (skinny and (_is_twist(joint[0]) or "Share" in joint[0]))]
    kept = {name for name, _, _ in joints}
    joints = [joint for joint in joints if not joint[1] or joint[1] in kept]
    names = tuple(name for name, _, _ in joints)
    at = {name: place for name, _, place in joints}
    offsets = torch.stack([place - at[parent] if parent else place for _, parent, place in joints])
    return Skeleton(names, tuple(names.index(p) if p else -1 for _, p, _ in joints), offsets)


def _is_twist(name):
    return "Twist0" in name and "Neck" not in name


def walking(rig_skeleton) -> tuple[Motion, Motion]:
    """A canonical walk, and on the rig, its twist bones turning with half of a joint's roll."""
    wanted = person(frames=30)
    plain = retarget.from_canonical(wanted, retarget.identify_rig(rig_skeleton))
    noise = random_motion(rig_skeleton, 30).local_quat_xyzw
    local = plain.local_quat_xyzw.clone()
    for joint, name in enumerate(rig_skeleton.names):
        if _is_twist(name):
            local[:, joint] = noise[:, joint]
    return wanted, Motion(rig_skeleton, plain.fps, plain.root_position, local, plain.moving_offsets)


@pytest.mark.parametrize("root", ["RL_BoneRoot", "CC_Base_BoneRoot"])
@pytest.mark.parametrize("skinny", [False, True])
def test_it_is_recognised_with_every_joint(root, skinny):
    wanted, clip = walking(skeleton(root, skinny))
    canonical, rigmap = retarget.to_canonical(clip)
    assert rigmap.rig.name == "iclone"
    assert rigmap.match is not None
    assert rigmap.match.score == 1
    names = clip.skeleton.names
    joints = {c: names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True) if j is not None}
    assert joints == names_of("iclone")
    assert joints["leftHand"] == "CC_Base_L_Hand"
    assert np.rad2deg(turn_between(canonical.joint_rotations(), wanted.joint_rotations())) < 1e-3
    torch.testing.assert_close(canonical.joint_positions(), wanted.joint_positions(), atol=1e-3, rtol=0)


def test_it_comes_back_to_the_bit_of_its_file(tmp_path):
    _, clip = walking(skeleton())
    clip.save(tmp_path / "in.bvh")
    read = mapctl.load(tmp_path / "in.bvh")
    canonical, rigmap = retarget.to_canonical(read)
    back = retarget.from_canonical(canonical, rigmap, read)
    assert turn_between(back.local_quat_xyzw, read.local_quat_xyzw) < 1e-6
    torch.testing.assert_close(back.joint_positions(), read.joint_positions(), atol=1e-8, rtol=0)
