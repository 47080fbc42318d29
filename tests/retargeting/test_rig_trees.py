"""Rigs with the trees that programs give them: twists in the chain of a limb, metatarsals, correctives, controls."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import turn_between
from rig_maker import Make, make, names_of, person
from rig_trees import TREES

from mapctl import retarget
from mapctl.retarget.doubts import assess_fit
from mapctl.skeleton import CANONICAL


@pytest.mark.parametrize(("preset", "version", "arms"), [(*tree, 40 * (k % 2)) for k, tree in enumerate(TREES)])
def test_a_rig_as_a_program_writes_it_is_known_and_comes_back(preset, version, arms):
    wish = replace(TREES[preset, version], arms_down_deg=arms, extras=False)
    made, wanted = make(wish), person(1.0, 30)
    motion = made.motion(wanted)
    canonical, rigmap = retarget.to_canonical(motion)
    absent = CANONICAL.num_joints - len(made.joint)
    assert rigmap.rig.name == preset
    assert rigmap.match.score == pytest.approx(1.0 - 0.6 * absent / CANONICAL.num_joints)
    assert rigmap.joint_names == dict(made.joint)
    assert (rigmap.rest, rigmap.up) == ("T" if arms == 0 else "A", "z" if wish.zup else "y")
    facing = {(False, 0): "z", (False, 180): "-z", (True, 0): "-y"}[wish.zup, wish.turned_deg]
    assert rigmap.facing == facing
    assert assess_fit(rigmap, motion).doubts == ()
    known = [CANONICAL.index(name) for name in made.joint]
    turned = turn_between(canonical.joint_rotations()[:, known], wanted.joint_rotations()[:, known])
    assert np.rad2deg(turned) < 0.01
    # Twists in the chain move no joint of a limb: hands and feet are where they are in truth.
    places = canonical.joint_positions()[:, known], wanted.joint_positions()[:, known]
    torch.testing.assert_close(*places, atol=1e-6, rtol=0)
    back = retarget.from_canonical(canonical, rigmap, motion)
    assert turn_between(back.local_quat_xyzw, motion.local_quat_xyzw) < 1e-6
    torch.testing.assert_close(back.joint_positions(), motion.joint_positions(), atol=1e-8, rtol=0)


@pytest.mark.parametrize(
    "tree", [("daz-genesis", "3 and 8"), ("rigify", "deforming"), ("makehuman", "default")], ids=str
)
def test_another_motion_on_limbs_of_two_halves_puts_hands_and_feet_where_they_belong(tree):
    """Without the rig's own motion the twists rest."""
    made, wanted = make(replace(TREES[tree], arms_down_deg=40, extras=False)), person(1.0, 20)
    rigmap = retarget.identify_rig(made.skeleton, motion=made.motion(wanted))
    on_rig = retarget.from_canonical(replace(wanted, skeleton=rigmap.skeleton), rigmap)
    known = [CANONICAL.index(name) for name in made.joint]
    places = retarget.rig_joint_positions(on_rig, rigmap)[:, known]
    torch.testing.assert_close(places, wanted.joint_positions()[:, known], atol=1e-6, rtol=0)


def test_metahuman_is_told_from_ue5_by_its_further_joints_and_both_take_the_same_ones():
    alone = make(Make(names_of("metahuman"))).skeleton
    whole = make(TREES["metahuman", "body and face"]).skeleton
    assert retarget.identify_rig(alone).rig.name == "ue5"
    assert retarget.identify_rig(whole).rig.name == "metahuman"
    assert retarget.load_rig("ue5").joints == retarget.load_rig("metahuman").joints


@pytest.mark.parametrize(
    ("trunk", "chest"),
    [
        (("Spine",), None),
        (("Spine", "Spine1"), "Spine1"),
        (("Spine", "Spine1", "Spine2"), "Spine2"),
        (("Spine", "Spine1", "Spine2", "Spine3"), "Spine3"),
    ],
)
def test_of_rigs_that_share_names_the_chest_is_what_the_arms_hang_from(trunk, chest):
    """HumanIK's names without prefix have trunks of one to ten joints."""
    names = names_of("mixamo", 1) | {"chest": trunk[-1]} if chest else names_of("mixamo", 1)
    if chest is None:
        del names["chest"]
    made = make(Make(names, between={"chest": trunk[1:-1]} if chest else {}, extras=False))
    found = retarget.identify_rig(made.skeleton).joint_names
    assert found.get("chest") == chest
    assert found["spine"] == "Spine"
