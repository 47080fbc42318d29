"""Names of joints: canonical ones and the rig's own, in any case, and suggestions that stay on their side and limb."""

import pytest
from captures import on_rig
from helpers import random_motion, run
from hypothesis import given
from hypothesis import strategies as st
from rig_maker import Make, make, names_of, person, versions_of

from controllers.inbetweening.keyframes import effector_joint
from mapctl.errors import MapctlError, RequestError
from mapctl.joint_names import Side, abbreviate_names, classify_joint, describe_nearest, find_joint, suggest_joints
from mapctl.recording.masks import ALL, ROOT, Mask, expand_valid_masks, resolve_joint_names
from mapctl.retarget import canonical_joints, identify_rig, rigs
from mapctl.skeleton import CANONICAL, LIMBS

VERSIONS = [(rig.name, version) for rig in rigs.known_rigs() for version in range(versions_of(rig.name))]
ENDS = [side + part for side in ("left", "right") for part in ("Hand", "Foot")]


def spellings(name):
    return name, name.lower(), name.upper(), name[0].upper() + name[1:]


@pytest.mark.parametrize(("preset", "version"), VERSIONS)
def test_every_rig_knows_its_own_and_the_canonical_names_in_any_case(preset, version):
    names = names_of(preset, version)
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


@pytest.mark.parametrize(("preset", "version"), VERSIONS)
def test_hands_and_feet_are_found_on_every_rig(preset, version):
    names = names_of(preset, version)
    rigmap = identify_rig(make(Make(names)).skeleton)
    for end in ENDS:
        for word in {*spellings(end), names[end], names[end].lower()}:
            assert CANONICAL.names[effector_joint(word, rigmap)] == end or word in rigmap.rig_skeleton.names


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


def test_canonical_names_are_looked_up_only_where_they_are_needed():
    def never():
        raise AssertionError

    assert find_joint("Hips", ("Hips",), never) == 0


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


ASKED = {
    "LeftForeArm": "leftHand",
    "left_arm": "leftHand",
    "rElbow": "rightHand",
    "LeftKnee": "leftFoot",
    "r_thigh": "rightFoot",
    "leftHnad": "leftHand",
    "L_Ankle": "leftFoot",
    "RightToe": "rightFoot",
}


@pytest.mark.parametrize(("asked", "meant"), ASKED.items())
@pytest.mark.parametrize("preset", ["mixamo", "cmu-daz", "bandai-namco", "ue5", "iclone"])
def test_hands_and_feet_are_suggested_on_the_side_and_limb_that_were_asked_for(preset, asked, meant):
    names = {c: own for c, own in names_of(preset).items() if not asked.startswith("RightToe") or "Toes" not in c}
    rigmap = identify_rig(make(Make(names)).skeleton)
    with pytest.raises(RequestError) as refused:
        effector_joint(asked, rigmap)
    assert f"the nearest is {names[meant]}" in str(refused.value)


@pytest.mark.slow
@given(st.sampled_from(CANONICAL.names), st.data())
def test_suggestions_stay_on_the_side_whatever_is_mistyped(name, data):
    side, part = classify_joint(name).side, name.removeprefix("left").removeprefix("right")
    at = data.draw(st.integers(0, len(part) - 1))
    typo = name[: len(name) - len(part)] + part[:at] + part[at + 1 :]
    for preset in ("mixamo", "ue5", "cmu-daz"):
        names = list(names_of(preset).values())
        found = suggest_joints(typo, names)
        assert 0 < len(found) <= 3
        if classify_joint(typo).side is not Side.MIDDLE:
            assert {classify_joint(one).side for one in found} == {side}


def test_a_refusal_names_few_joints():
    many = [f"Bone{number:03d}" for number in range(200)]
    assert describe_nearest("Bone07", many).count("Bone") == 3
    assert abbreviate_names(many).count("Bone") == 6
    assert abbreviate_names(many).endswith(" and 194 more")
    assert abbreviate_names(many[:2]) == "Bone000, Bone001"
    assert describe_nearest("x", ()) == "the nearest is none"


@pytest.mark.parametrize("words", [("info",), ("convert", "--rig", "canonical"), ("measure",)])
def test_no_refusal_of_a_rig_lists_sixty_joints(words, tmp_path, capsys):
    skeleton = make(Make({c: f"Glied_{n:02d}" for n, c in enumerate(CANONICAL.names) if "Leg" not in c})).skeleton
    crowd = type(skeleton)(
        (*skeleton.names, *(f"Knochen_{n:02d}" for n in range(70))),
        (*skeleton.parents, *[0] * 70),
        skeleton.offsets.new_zeros(len(skeleton.names) + 70, 3),
    )
    random_motion(crowd, 2).save(tmp_path / "a.bvh")
    command, *options = words
    more = [tmp_path / "b.bvh"] if command == "convert" else []
    assert run(command, tmp_path / "a.bvh", *more, *options) == 2
    told = capsys.readouterr().err
    assert told.count("Knochen_") + told.count("Glied_") <= 12
    assert told.count("\n") == 1


def test_a_skeleton_names_the_nearest_joints():
    with pytest.raises(MapctlError, match="no joint 'leftHnd'; the nearest is leftHand, then "):
        CANONICAL.index("leftHnd")


def test_all_limbs_have_names():
    assert set(LIMBS) == set(ENDS)
