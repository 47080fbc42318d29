"""What is doubtful about how a rig is understood: never a wrong match that is sure, and no doubt about the listed."""

import math
import random
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from helpers import bandai_skeleton, cmu_skeleton, walk
from rig_maker import Make, make, names_of, person
from rig_trees import TREES
from strange_rigs import CASES, DOUBTFUL, REFUSED, SURE, renamed, rigged, stretched, swap, with_joints

from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.retarget import body_plan, rigs
from mapctl.retarget.doubts import Fit, assess_fit
from mapctl.retarget.joint_matching import KnownBy
from mapctl.retarget.rig_poses import RigPoses
from mapctl.skeleton import CANONICAL


def judge(motion):
    """The verdict, its reasons in one text, and the rig as it was understood."""
    try:
        rigmap = retarget.to_canonical(motion)[1]
    except RequestError as refusal:
        return REFUSED, str(refusal), None
    fit = assess_fit(rigmap, motion)
    return fit.verdict, "; ".join(doubt.reason for doubt in fit.doubts), rigmap


@pytest.mark.parametrize("label", CASES)
def test_strange_rigs_are_refused_or_doubtful_or_right(label):
    case = CASES[label]
    verdict, why, rigmap = judge(case.motion)
    assert verdict in case.allowed, why
    assert case.reason in why
    if verdict == SURE and case.truth is not None:
        assert rigmap.joint_names == dict(case.truth)
    if case.rig is not None:
        assert rigmap.rig.name == case.rig
    if rigmap is not None:  # and whatever is said of it, the motion comes back
        back = retarget.from_canonical(*retarget.to_canonical(case.motion), case.motion)
        torch.testing.assert_close(back.joint_positions(), case.motion.joint_positions(), atol=1e-6, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["mixamo", "ue5", "smpl", "cmu-daz", "rigify", "xsens"])
def test_names_in_disorder_are_never_a_sure_match(preset):
    order = random.Random(3)
    for pairs in (1, 1, 1, 1, 2, 6):
        names = names_of(preset)
        mixed = swap(names, *(order.sample(list(names), 2) for _ in range(pairs)))
        verdict, _, rigmap = judge(rigged(mixed, arms_down_deg=40)[0])
        assert verdict != SURE or rigmap.joint_names == mixed


LOST = [
    pytest.param(tree, name, marks=() if name in ("leftHand", "chest") else pytest.mark.slow)
    for tree in TREES
    if tree != ("rigify", "everything")  # every joint is there thrice, in one place
    for name in ("leftHand", "chest", "head", "leftFoot", "leftLowerArm", "leftShoulder", "leftToes")
    if name in TREES[tree].names
]


@pytest.mark.parametrize(("tree", "name"), LOST, ids=str)
def test_a_rig_of_which_a_joint_lost_its_name_is_never_understood_wrongly_and_surely(tree, name):
    wish = replace(TREES[tree], names={**TREES[tree].names, name: "a17"}, extras=False, arms_down_deg=30)
    made = make(wish)
    verdict, _, rigmap = judge(made.motion(person(1.0, 30)))
    if verdict == SURE:
        assert rigmap.joint_names == {c: own for c, own in made.joint.items() if c in rigmap.joint_names}


@pytest.mark.parametrize("name", ["leftHand", "leftLowerArm", "leftFoot", "leftToes", "leftShoulder"])
@pytest.mark.parametrize("tree", [("daz-genesis", "3 and 8"), ("xsens", "BVH"), ("unity", "avatar")], ids=str)
def test_a_joint_without_a_name_is_found_by_the_other_side(tree, name):
    wish = replace(TREES[tree], names={**TREES[tree].names, name: "a17"}, extras=False, arms_down_deg=30)
    verdict, why, rigmap = judge(make(wish).motion(person(1.0, 30)))
    assert (verdict, rigmap.joint_names[name]) == (DOUBTFUL, "a17")
    assert f"{name} is known by its position alone (joint 'a17')" in why


@pytest.mark.parametrize("preset", [rig.name for rig in rigs.known_rigs() if rig.name != "metahuman"])
def test_no_listed_rig_is_doubtful(preset):
    for wish in (Make(names_of(preset)), Make(names_of(preset), arms_down_deg=50, zup=True, root="Ground")):
        assert judge(make(wish).motion(person(1.0, 30)))[:2] == (SURE, "")


@pytest.mark.parametrize("skeleton", [bandai_skeleton(), cmu_skeleton()], ids=["Bandai Namco", "CMU"])
def test_the_rigs_of_the_data_are_sure(skeleton):
    motion = retarget.from_canonical(walk(20), retarget.identify_rig(skeleton))
    assert judge(motion)[:2] == (SURE, "")


def test_each_joint_says_what_it_is_known_by():
    rigmap = retarget.identify_rig(
        rigged(names_of("mixamo") | {"leftHand": "a17", "rightHand": "RightHandle"})[0].skeleton
    )
    known = rigmap.match.known_by
    assert (known["leftHand"], known["rightHand"], known["head"]) == (KnownBy.PLACE, KnownBy.WORDS, KnownBy.LIST)
    assert "leftHand" in assess_fit(rigmap).joints


def test_what_the_other_side_shows_is_above_what_is_known_of_its_own_side():
    """A decoy with as many joints as the right shoulder has; the left arm hangs from the true one."""
    motion = rigged(names_of("mixamo") | {"leftShoulder": "a17"})[0]
    chest, length = names_of("mixamo")["chest"], float(motion.skeleton.offsets[motion.skeleton.index("a17")].norm())
    decoy = [(f"d{n}", f"d{n - 1}" if n else chest, (length, 0.0, 0.0)) for n in range(8)]
    rigmap = retarget.identify_rig(with_joints(motion, decoy).skeleton)
    assert rigmap.joint_names["leftShoulder"] == "a17"


def test_a_name_of_another_part_contradicts_a_place():
    names = {c: f"b{n}" for n, c in enumerate(CANONICAL.names)} | {"leftLowerArm": "some_shin", "head": "sole_foot"}
    verdict, why, _ = judge(rigged(names, extras=False)[0])
    assert verdict == REFUSED or "whose name is that of a" in why


def test_another_listed_rig_that_fits_almost_as_well_is_no_doubt():
    """CMU's names in MotionBuilder hold those of Optitrack, which has another neck."""
    between = {"neck": "Neck", "leftUpperLeg": "LHipJoint", "rightUpperLeg": "RHipJoint", "spine": "LowerBack"}
    wish = Make(names_of("cmu-motionbuilder"), between={c: (own,) for c, own in between.items()}, extras=False)
    ends = [
        (name.format(side), f"{side}Hand") for side in ("Left", "Right") for name in ("{}FingerBase", "{}HandIndex1")
    ]
    ends += [("LThumb", "LeftHand"), ("RThumb", "RightHand")]
    motion = with_joints(make(wish).motion(person(1.0, 30)), [(*end, (0.05, 0.0, 0.0)) for end in ends])
    verdict, why, rigmap = judge(motion)
    assert (verdict, why, rigmap.rig.name) == (SURE, "", "cmu-motionbuilder")
    assert rigmap.joint_names["neck"] == "Neck1"


def test_a_clip_without_bent_knees_leaves_the_twist_of_limbs_open():
    made = make(Make(names_of("mixamo"), bones_along_x=True))
    stiff = replace(person(1.0, 20), local_quat_xyzw=torch.tensor([0.0, 0, 0, 1]).double().expand(20, 21, 4).clone())
    drop = replace(stiff, local_quat_xyzw=stiff.local_quat_xyzw)
    arms = [CANONICAL.index(side + "UpperArm") for side in ("left", "right")]
    for arm, sign in zip(arms, (-1.0, 1.0), strict=True):  # hanging, so that the clip does not begin with a T-pose
        drop.local_quat_xyzw[:, arm] = torch.tensor([0.0, 0.0, sign * 0.6, 0.8]).double()
    verdict, why, _ = judge(made.motion(drop))
    assert (verdict, "knees hardly bend" in why) == (DOUBTFUL, True)
    bent = person(1.0, 20)
    for knee in (CANONICAL.index("leftLowerLeg"), CANONICAL.index("rightLowerLeg")):
        bent.local_quat_xyzw[:, knee] = torch.tensor([0.2, 0.0, 0.0, 0.96**0.5]).double()
    assert judge(made.motion(bent))[0] == SURE


def test_somebody_who_lies_or_crawls_is_a_person_all_the_same_and_it_is_said():
    lying = person(1.0, 10)
    turn = torch.tensor([-(0.5**0.5), 0.0, 0.0, 0.5**0.5]).double()
    laid = lying.local_quat_xyzw.clone()
    laid[:, 0] = turn
    verdict, why, rigmap = judge(make(Make(names_of("mixamo"))).motion(replace(lying, local_quat_xyzw=laid)))
    assert verdict == DOUBTFUL
    assert "lies or hangs" in why
    assert rigmap.joint_names == names_of("mixamo")


def test_a_body_on_four_legs_is_taken_where_the_user_says_so():
    motion = CASES["a dog with a person's names"].motion
    rig = retarget.load_rig("mixamo")
    assert retarget.identify_rig(motion.skeleton, rig).joint_names["leftHand"] == "LeftHand"


def test_second_bodies_and_controls_in_the_same_place():
    rigmap = retarget.identify_rig(CASES["two people by name"].motion.skeleton)
    zero = RigPoses.zero(rigmap.rig_skeleton, rigmap.joint_of)
    hips = body_plan.find_second_body(zero, rigmap.joints)
    assert rigmap.rig_skeleton.names[hips] == "char2:Hips"
    one = replace(CASES["two people by name"].motion)
    offsets = one.skeleton.offsets.clone()
    offsets[one.skeleton.index("char2:Hips")] = offsets[one.skeleton.index("char1:Hips")]
    same = retarget.identify_rig(replace(one.skeleton, offsets=offsets))
    assert body_plan.find_second_body(RigPoses.zero(same.rig_skeleton, same.joint_of), same.joints) is None


def test_a_fit_without_doubts_is_sure():
    assert Fit(()).verdict == SURE
    assert Fit(()).joints == frozenset()


def _stretched_trunk():
    walking, names = rigged(names_of("mixamo"), extras=False)[0], names_of("mixamo")
    return stretched(walking, **{names["chest"]: 16.0})


REASONS = {
    "does not hang from leftLowerArm": lambda: rigged(swap(names_of("mixamo"), ("leftLowerArm", "leftHand")))[0],
    "is below": lambda: rigged(swap(names_of("mixamo"), ("hips", "spine")))[0],
    "between chest 'mixamorig:Spine1' and leftShoulder": lambda: make(
        Make(names_of("mixamo") | {"chest": "a17"}, between={"chest": ("mixamorig:Spine1",)}, extras=False)
    ).motion(person(1.0, 10)),
    "which is named otherwise": lambda: make(
        replace(TREES["metahuman", "body and face"], names={**names_of("metahuman"), "leftHand": "a17"}, extras=False)
    ).motion(person(1.0, 10)),
    "nothing shows the front": lambda: rigged(
        {c: f"b{n}" for n, c in enumerate(CANONICAL.names) if "Toes" not in c}, extras=False, end_sites=False
    )[0],
    "trunk is": _stretched_trunk,
}
"""A motion by what is doubtful about its rig."""


@pytest.mark.parametrize("reason", REASONS)
def test_each_reason_is_given_where_it_holds(reason):
    verdict, why, _ = judge(REASONS[reason]())
    assert verdict == DOUBTFUL
    assert reason in why


def test_an_animal_is_told_by_its_paws_in_any_pose():
    made = make(Make(names_of("mixamo"), extras=False))
    standing = RigPoses.zero(made.skeleton, retarget.identify_rig(made.skeleton).joint_of)
    assert not body_plan.goes_on_four_legs(made.skeleton, standing, None)
    paws = renamed(made.motion(person(1.0, 2)), lambda name: name.replace("Hand", "Paw")).skeleton
    assert body_plan.goes_on_four_legs(paws, standing, None)


@pytest.mark.parametrize(("knee_deg", "four"), [(40.0, False), (0.0, True)])
def test_a_crouch_with_hanging_arms_is_no_walk_on_four_legs(knee_deg, four):
    """A level trunk and arms straight down: a person's hands stay over the floor, where an animal stands on them."""
    pose = torch.tensor([0.0, 0, 0, 1]).double().repeat(1, CANONICAL.num_joints, 1)

    def bend(name, axis, degrees):
        vector = torch.zeros(3, dtype=torch.float64)
        vector[axis] = math.radians(degrees)
        pose[0, CANONICAL.index(name)] = rotations.from_rotation_vector(vector)

    bend("hips", 0, 85)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        bend(side + "UpperArm", 1, -90 * sign)
        bend(side + "UpperLeg", 0, -85 - knee_deg / 2)
        bend(side + "LowerLeg", 0, knee_deg)
    arms = 1.0 if not four else 1.6
    offsets = CANONICAL.offsets.clone()
    offsets[CANONICAL.indices([side + part for side in ("left", "right") for part in ("LowerArm", "Hand")])] *= arms
    body = replace(CANONICAL, offsets=offsets)
    motion = Motion(body, Fraction(30), torch.zeros(1, 3, dtype=torch.float64), pose)
    poses = RigPoses.of(motion, range(CANONICAL.num_joints))
    assert body_plan.goes_on_four_legs(body, poses, None) is four
