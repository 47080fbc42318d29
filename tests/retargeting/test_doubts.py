"""Doubts about a rig: never a wrong match that is sure, and no doubt about the listed."""

from dataclasses import replace

import pytest
import torch
from rig_maker import Make, make, names_of, person
from rig_trees import TREES
from strange_rigs import CASES, DOUBTFUL, REFUSED, SURE

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.retarget import rigs
from mapctl.retarget.doubts import assess_fit
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


LOST = [(tree, ("leftHand", "chest")[k % 2]) for k, tree in enumerate(TREES)]
LOST = [(tree, name) for tree, name in LOST if tree != ("rigify", "everything")]  # where every joint is there thrice
LOST = [(tree, name) for tree, name in LOST if name in TREES[tree].names]


@pytest.mark.parametrize(("tree", "name"), LOST, ids=str)
def test_a_rig_of_which_a_joint_lost_its_name_is_never_understood_wrongly_and_surely(tree, name):
    rig_request = replace(TREES[tree], names={**TREES[tree].names, name: "a17"}, extras=False, arms_down_deg=30)
    result = make(rig_request)
    verdict, _, rigmap = judge(result.motion(person(1.0, 30)))
    if verdict == SURE:
        assert rigmap.joint_names == {c: own for c, own in result.joint.items() if c in rigmap.joint_names}


@pytest.mark.parametrize("name", ["leftLowerArm", "leftFoot", "leftShoulder"])
@pytest.mark.parametrize("tree", [("daz-genesis", "3 and 8"), ("xsens", "BVH"), ("unity", "avatar")], ids=str)
def test_a_joint_without_a_name_is_found_by_the_other_side(tree, name):
    rig_request = replace(TREES[tree], names={**TREES[tree].names, name: "a17"}, extras=False, arms_down_deg=30)
    verdict, why, rigmap = judge(make(rig_request).motion(person(1.0, 30)))
    assert (verdict, rigmap.joint_names[name]) == (DOUBTFUL, "a17")
    assert f"{name} is known by its position alone (joint 'a17')" in why


@pytest.mark.parametrize("preset", [rig.name for rig in rigs.known_rigs() if rig.name != "metahuman"])
def test_no_listed_rig_is_doubtful(preset):
    for rig_request in (Make(names_of(preset)), Make(names_of(preset), arms_down_deg=50, zup=True, root="Ground")):
        assert judge(make(rig_request).motion(person(1.0, 30)))[:2] == (SURE, "")


def test_a_clip_without_bent_knees_leaves_the_twist_of_limbs_open():
    result = make(Make(names_of("mixamo"), bones_along_x=True))
    stiff = replace(person(1.0, 20), local_quat_xyzw=torch.tensor([0.0, 0, 0, 1]).double().expand(20, 21, 4).clone())
    drop = replace(stiff, local_quat_xyzw=stiff.local_quat_xyzw)
    arms = [CANONICAL.index(side + "UpperArm") for side in ("left", "right")]
    for arm, sign in zip(arms, (-1.0, 1.0), strict=True):  # hanging, so that the clip does not begin with a T-pose
        drop.local_quat_xyzw[:, arm] = torch.tensor([0.0, 0.0, sign * 0.6, 0.8]).double()
    verdict, why, _ = judge(result.motion(drop))
    assert (verdict, "knees hardly bend" in why) == (DOUBTFUL, True)
    bent = person(1.0, 20)
    for knee in (CANONICAL.index("leftLowerLeg"), CANONICAL.index("rightLowerLeg")):
        bent.local_quat_xyzw[:, knee] = torch.tensor([0.2, 0.0, 0.0, 0.96**0.5]).double()
    assert judge(result.motion(bent))[0] == SURE


def test_a_lying_or_crawling_body_is_read_as_a_person_with_a_note():
    lying = person(1.0, 10)
    turn = torch.tensor([-(0.5**0.5), 0.0, 0.0, 0.5**0.5]).double()
    laid = lying.local_quat_xyzw.clone()
    laid[:, 0] = turn
    verdict, why, rigmap = judge(make(Make(names_of("mixamo"))).motion(replace(lying, local_quat_xyzw=laid)))
    assert verdict == DOUBTFUL
    assert "lies, crawls or hangs" in why
    assert rigmap.joint_names == names_of("mixamo")
