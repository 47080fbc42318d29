"""Any rig to canonical joints and back: listed ones with the trees that programs give them, and others."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import bandai_skeleton, cmu_skeleton, generator, random_motion, turn_between
from rig_maker import Make, make, names_of, person, versions_of
from rig_trees import TREES
from scipy.spatial.transform import Rotation

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.retarget import rigs
from mapctl.retarget.doubts import assess_fit
from mapctl.retarget.joint_matching import MIN_SCORE, match
from mapctl.skeleton import CANONICAL, Skeleton

PRESETS = [rig.name for rig in rigs.known_rigs()]
VERSIONS = [(preset, version) for preset in PRESETS for version in range(versions_of(preset))]
RESTS = {
    "T": Make({}),
    "A, Z up, below a root, facing back": Make({}, arms_down_deg=45, zup=True, turned_deg=180, root="Ground", size=1.3),
    "no pose, bones along x": Make({}, bones_along_x=True, size=0.8),
    "no pose, Z up": Make({}, bones_along_x=True, zup=True),
}
TRUNK = ["Rumpf_Pelvis", "belly", "upperBack", "nape_neck", "skull"]
LIMB = ["collarbone", "humerus", "elbow", "wrist", "thighbone", "kneejoint", "anklejoint", "toe_root"]
INVENTED = dict(zip(CANONICAL.names, TRUNK + [f"{part}.{side}" for side in "LR" for part in LIMB], strict=True))
NONSENSE = {name: f"bone_{number}" for number, name in enumerate(CANONICAL.names)}


def assert_returns(motion, canonical, rigmap):
    """Every joint, within 0.01 degree and 0.1 mm and far less."""
    back = retarget.from_canonical(canonical, rigmap, motion)
    assert turn_between(back.local_quat_xyzw, motion.local_quat_xyzw) < 1e-6
    torch.testing.assert_close(back.joint_positions(), motion.joint_positions(), atol=1e-8, rtol=0)
    assert back.moving_offsets.keys() == motion.moving_offsets.keys()


def assert_understood(result, wanted, canonical, rigmap, *, degrees=2.0):
    """The right joints, turned as they are in truth, and the hips where they are."""
    names = {
        c: result.skeleton.names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True) if j is not None
    }
    assert names == dict(result.joint)
    known = [CANONICAL.index(name) for name in result.joint]
    turned = turn_between(canonical.joint_rotations()[:, known], wanted.joint_rotations()[:, known])
    assert np.rad2deg(turned) < degrees
    torch.testing.assert_close(canonical.root_position, wanted.root_position, atol=1e-6, rtol=0)


def converted(rig_request, *, frames=40):
    """A requested rig, a walk on it, the walk as it is read, and the walk itself."""
    result, wanted = make(rig_request), person(rig_request.size, frames)
    motion = result.motion(wanted)
    return result, wanted, motion, *retarget.to_canonical(motion)


# LaFAN1's axes along its bones are known (its table), and are not those of the bodies that are built here.
EVERY_PRESET = [
    (*case, "T" if case[0] == "lafan1" else list(RESTS)[number % len(RESTS)]) for number, case in enumerate(VERSIONS)
]
"""Every version in one of the rest poses, each of which comes with several versions."""


@pytest.mark.parametrize(("preset", "version", "rest"), EVERY_PRESET)
def test_every_preset_there_and_back(preset, version, rest):
    result, wanted, motion, canonical, rigmap = converted(replace(RESTS[rest], names=names_of(preset, version)))
    assert rigmap.rig.name == ("ue5" if preset == "metahuman" else preset)  # which further joints tell apart
    assert rigmap.match.score > 0.9
    assert_understood(result, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)


@pytest.mark.parametrize("rest", RESTS)
@pytest.mark.parametrize(("names", "least"), [(INVENTED, 0.75), (NONSENSE, MIN_SCORE)], ids=["invented", "nonsense"])
def test_a_rig_that_nobody_listed(names, least, rest):
    result, wanted, motion, canonical, rigmap = converted(replace(RESTS[rest], names=names))
    assert least < rigmap.match.score <= 1
    assert_understood(result, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)
    assert set(rigmap.match.unmapped) == set(result.skeleton.names) - set(names.values())


@pytest.mark.parametrize("along", [False, True], ids=["T", "no pose"])
@pytest.mark.parametrize("preset", ["mixamo", "ue4", "cmu-daz", "bandai-namco"])
def test_left_is_where_the_left_is_not_what_is_called_so(preset, along):
    result, wanted, motion, canonical, rigmap = converted(Make(names_of(preset), swapped=True, bones_along_x=along))
    assert rigmap.match.sides_exchanged
    assert_understood(result, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)


@pytest.mark.parametrize("gone", ["Toes", "Hand", "chest neck Shoulder Toes"])
@pytest.mark.parametrize("preset", ["mixamo", "ue4", "smpl"])
def test_what_a_rig_may_lack(preset, gone):
    lacking = gone.split()
    names = {c: own for c, own in names_of(preset).items() if not c.endswith(tuple(lacking))}
    result, wanted, motion, canonical, rigmap = converted(Make(names, extras=False))
    assert_understood(result, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)
    for c, joint in enumerate(rigmap.joint_of):
        if joint is not None:
            positions = canonical.joint_positions()[:, c], motion.joint_positions()[:, joint]
            torch.testing.assert_close(*positions, atol=1e-8, rtol=0)
    # What is put in lies about where it would be.
    lengths = rigmap.skeleton.offsets[1:].norm(dim=-1)
    assert float(lengths.min()) > 0.01
    assert float((canonical.joint_positions() - wanted.joint_positions()).norm(dim=-1).max()) < 0.08


def test_a_horse_is_refused():
    names = ("root", "belly", "front_l", "front_l2", "hind_l", "hind_l2", "tail")
    horse = Skeleton(names, (-1, 0, 1, 2, 0, 4, 0), torch.rand(7, 3, generator=generator()).double())
    with pytest.raises(RequestError, match=r"no joint is found for leftUpperArm, .*known rigs"):
        match(horse)


def test_a_clip_that_begins_with_a_t_pose_shows_what_its_zero_pose_does_not():
    """A rig whose joints are turned at random: only the first frame shows how."""
    result, wanted = make(Make(names_of("xsens"), extras=False)), person(1.0, 30)
    frames = Rotation.random(result.skeleton.num_joints, rng=3)
    turned = dict(zip(result.skeleton.names, frames, strict=True))
    offsets = [result.skeleton.offsets[0]] + [
        torch.from_numpy(frames[p].inv().apply(result.skeleton.offsets[j].numpy()))
        for j, p in enumerate(result.skeleton.parents)
        if p >= 0
    ]
    still = torch.tensor([0.0, 0, 0, 1]).double().expand(1, 21, 4)
    begins = replace(wanted, root_position=wanted.root_position[:1], local_quat_xyzw=still).join(wanted)
    strange = replace(
        result,
        skeleton=replace(result.skeleton, offsets=torch.stack(offsets), end_offsets={}),
        tpose={c: turned[own] for c, own in result.joint.items()},
    )
    motion = strange.motion(begins)
    canonical, rigmap = retarget.to_canonical(motion)
    assert (rigmap.rest, rigmap.tpose_from) == ("neither", "frame 0")
    assert_understood(strange, begins, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)


@pytest.mark.parametrize("rest", RESTS)
def test_a_part_of_a_clip_is_converted_as_the_whole_was(rest):
    *_, motion, canonical, rigmap = converted(replace(RESTS[rest], names=names_of("vicon")))
    part, again = retarget.to_canonical(motion.slice(30, 33), retarget.as_rig(rigmap))
    assert again.joint_of == rigmap.joint_of
    assert turn_between(part.local_quat_xyzw, canonical.local_quat_xyzw[30:33]) < 1e-6
    torch.testing.assert_close(part.joint_positions(), canonical.joint_positions()[30:33], atol=1e-8, rtol=0)
    assert_returns(motion.slice(30, 33), part, again)


def test_hips_below_a_travelling_root_move_with_it():
    """A changed motion is carried by the root, since the file's hips do not travel within it."""
    *_, motion, canonical, rigmap = converted(Make(names_of("ue5"), root="root"))
    there = replace(canonical, root_position=canonical.root_position + 1)
    back = retarget.from_canonical(there, rigmap, motion)
    assert not back.moving_offsets
    torch.testing.assert_close(back.root_position, motion.root_position + 1, atol=1e-9, rtol=0)


TOML = """
name = "ours"
up = "{up}"
rest = "{rest}"
facing = "{facing}"
unit = "{unit}"
[joints]
hips = "Rumpf_Pelvis"
spine = "belly"
"""


def test_a_toml_file_wins(tmp_path):
    result, wanted, motion, *_ = converted(Make(INVENTED, zup=True, arms_down_deg=20))
    path = tmp_path / "ours.toml"
    path.write_text(TOML.format(up="z", rest="straighten", facing="-y", unit="cm"))
    rig = retarget.load_rig(path)
    assert (rig.name, rig.up, rig.metres_per_unit) == ("ours", "z", 0.01)
    canonical, rigmap = retarget.to_canonical(motion, rig)
    assert rigmap.rig is rig
    assert_understood(result, wanted, canonical, rigmap)
    path.write_text(TOML.format(up="y", rest="tpose", facing="auto", unit="m"))
    canonical, rigmap = retarget.to_canonical(motion, retarget.load_rig(path))
    assert (rigmap.up, rigmap.tpose_from) == ("y", "table")
    assert_returns(motion, canonical, rigmap)


def test_a_toml_file_names_both_sides_at_once(tmp_path):
    path = tmp_path / "ours.toml"
    joints = 'hips = "Pelvis"\nUpperArm = ["*Arm", "*_arm", "arm_*"]\nleftHand = "Hook"\n'
    path.write_text(f'left = ["L", "left"]\nright = ["R", "right"]\nalso = ["*Thumb"]\n[joints]\n{joints}')
    rig = retarget.load_rig(path)
    assert rig.joints == {"hips": "Pelvis", "leftHand": "Hook", "leftUpperArm": "LArm", "rightUpperArm": "RArm"}
    assert rig.aliases["rightUpperArm"] == ("right_arm", "arm_right")
    assert rig.also == ("LThumb", "RThumb")


SKELETONS = {"bandai-namco": bandai_skeleton(), "cmu-daz": cmu_skeleton(), "canonical": CANONICAL}
each_rig = pytest.mark.parametrize("rig", SKELETONS)


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


def test_the_static_root_of_an_original_stays():
    motion = random_motion(bandai_skeleton(), 6)
    motion = replace(motion, moving_offsets={1: motion.root_position.flip(0)})
    canonical, rigmap = retarget.to_canonical(motion, retarget.as_rig(retarget.identify_rig(motion.skeleton)))
    moved = retarget.from_canonical(replace(canonical, root_position=canonical.root_position + 1), rigmap, motion)
    torch.testing.assert_close(moved.root_position, motion.root_position)
    hips = motion.joint_positions()[:, 1] + 1
    torch.testing.assert_close(moved.joint_positions()[:, 1], hips, atol=1e-9, rtol=0)


@pytest.mark.parametrize(("preset", "version", "arms"), [(*tree, 40 * (k % 2)) for k, tree in enumerate(TREES)])
def test_a_rig_as_a_program_writes_it_is_known_and_comes_back(preset, version, arms):
    rig_request = replace(TREES[preset, version], arms_down_deg=arms, extras=False)
    result, wanted, motion, canonical, rigmap = converted(rig_request, frames=30)
    absent = CANONICAL.num_joints - len(result.joint)
    assert rigmap.rig.name == preset
    assert rigmap.match.score == pytest.approx(1.0 - 0.6 * absent / CANONICAL.num_joints)
    assert (rigmap.rest, rigmap.up) == ("T" if arms == 0 else "A", "z" if rig_request.zup else "y")
    facing = {(False, 0): "z", (False, 180): "-z", (True, 0): "-y"}[rig_request.zup, rig_request.turned_deg]
    assert rigmap.facing == facing
    assert assess_fit(rigmap, motion).doubts == ()
    assert_understood(result, wanted, canonical, rigmap, degrees=0.01)
    # Twists in the chain move no joint of a limb: hands and feet are where they are in truth.
    known = [CANONICAL.index(name) for name in result.joint]
    positions = canonical.joint_positions()[:, known], wanted.joint_positions()[:, known]
    torch.testing.assert_close(*positions, atol=1e-6, rtol=0)
    assert_returns(motion, canonical, rigmap)


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
    result = make(Make(names, between={"chest": trunk[1:-1]} if chest else {}, extras=False))
    found = retarget.identify_rig(result.skeleton).joint_names
    assert found.get("chest") == chest
    assert found["spine"] == "Spine"
