"""Names of joints: canonical ones and the rig's own, in any case, and suggestions that stay on their side and limb."""

import pytest
from captures import on_rig
from helpers import random_motion
from rig_maker import Make, make, names_of, person

from mapctl.errors import RequestError
from mapctl.joint_names import find_joint
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks, resolve_joint_names
from mapctl.retarget import canonical_joints, rigs
from mapctl.skeleton import CANONICAL


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


@pytest.mark.parametrize("rig", ["daz", "bandai"])
def test_masks_take_canonical_names(rig):
    motion = on_rig(rig, 40)
    own = motion.skeleton.names[canonical_joints(motion)["leftHand"]]
    asked = [Mask("leftHand", 3, 9), Mask("LEFTHAND", 9, 12), Mask(ALL, 20, 21), Mask(ROOT, 0, 2)]
    told = resolve_joint_names(motion, asked)
    assert [mask.joint for mask in told] == [own, own, ALL, ROOT]
    assert [(mask.start, mask.stop) for mask in told] == [(mask.start, mask.stop) for mask in asked]
    assert (expand_valid_masks(motion, asked)[0] == expand_valid_masks(motion, told)[0]).all()


def test_names_of_a_rig_that_only_the_user_knows():
    motion = make(Make({c: f"b{n}" for n, c in enumerate(CANONICAL.names)}, extras=False)).motion(person(frames=3))
    given_rig = rigs.Rig("mine", {c: f"b{n}" for n, c in enumerate(CANONICAL.names)})
    (mask,) = resolve_joint_names(motion, [Mask("rightFoot", 0, 1)], given_rig)
    assert mask.joint == f"b{CANONICAL.names.index('rightFoot')}"
