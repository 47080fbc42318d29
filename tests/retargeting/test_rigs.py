"""Any rig to canonical joints and back: the listed ones, and those that nobody listed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import bandai_skeleton, cmu_skeleton, generator, turn_between, walk
from rig_maker import Make, make, names_of, person, versions_of
from scipy.spatial.transform import Rotation

import mapctl
from mapctl import kinematics, retarget, rotations
from mapctl.errors import RequestError
from mapctl.formats import bvh
from mapctl.retarget import rigs
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


def assert_understood(made, wanted, canonical, rigmap, *, degrees=2.0):
    """The right joints, turned as they are in truth, and the hips where they are."""
    names = {c: made.skeleton.names[j] for c, j in zip(CANONICAL.names, rigmap.joint_of, strict=True) if j is not None}
    assert names == dict(made.joint)
    known = [CANONICAL.index(name) for name in made.joint]
    turned = turn_between(canonical.joint_rotations()[:, known], wanted.joint_rotations()[:, known])
    assert np.rad2deg(turned) < degrees
    torch.testing.assert_close(canonical.root_position, wanted.root_position, atol=1e-6, rtol=0)


def converted(wish, *, frames=40):
    """A rig as wished, a walk on it, what of it comes out, and the walk itself."""
    made, wanted = make(wish), person(wish.size, frames)
    motion = made.motion(wanted)
    return made, wanted, motion, *retarget.to_canonical(motion)


# LaFAN1's axes along its bones are known (its table), and are not those of the bodies that are built here.
EVERY_PRESET = [
    (*case, "T" if case[0] == "lafan1" else list(RESTS)[number % len(RESTS)]) for number, case in enumerate(VERSIONS)
]
"""Every version in one of the rest poses, each of which comes with several versions."""


@pytest.mark.parametrize(("preset", "version", "rest"), EVERY_PRESET)
def test_every_preset_there_and_back(preset, version, rest):
    made, wanted, motion, canonical, rigmap = converted(replace(RESTS[rest], names=names_of(preset, version)))
    assert rigmap.rig.name == ("ue5" if preset == "metahuman" else preset)  # which further joints tell apart
    assert rigmap.match.score > 0.9
    assert_understood(made, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)


@pytest.mark.parametrize("rest", RESTS)
@pytest.mark.parametrize(("names", "least"), [(INVENTED, 0.75), (NONSENSE, MIN_SCORE)], ids=["invented", "nonsense"])
def test_a_rig_that_nobody_listed(names, least, rest):
    made, wanted, motion, canonical, rigmap = converted(replace(RESTS[rest], names=names))
    assert least < rigmap.match.score <= 1
    assert_understood(made, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)
    assert set(rigmap.match.unmapped) == set(made.skeleton.names) - set(names.values())


@pytest.mark.parametrize("along", [False, True], ids=["T", "no pose"])
@pytest.mark.parametrize("preset", ["mixamo", "ue4", "cmu-daz", "bandai-namco"])
def test_left_is_where_the_left_is_not_what_is_called_so(preset, along):
    made, wanted, motion, canonical, rigmap = converted(Make(names_of(preset), swapped=True, bones_along_x=along))
    assert rigmap.match.sides_exchanged
    assert_understood(made, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)


@pytest.mark.parametrize("gone", ["Toes", "Hand", "chest neck Shoulder Toes"])
@pytest.mark.parametrize("preset", ["mixamo", "ue4", "smpl"])
def test_what_a_rig_may_lack(preset, gone):
    lacking = gone.split()
    names = {c: own for c, own in names_of(preset).items() if not c.endswith(tuple(lacking))}
    made, wanted, motion, canonical, rigmap = converted(Make(names, extras=False))
    assert_understood(made, wanted, canonical, rigmap)
    assert_returns(motion, canonical, rigmap)
    for c, joint in enumerate(rigmap.joint_of):
        if joint is not None:
            places = canonical.joint_positions()[:, c], motion.joint_positions()[:, joint]
            torch.testing.assert_close(*places, atol=1e-8, rtol=0)
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
    """A rig whose joints are turned at random: only the first frame tells how."""
    made, wanted = make(Make(names_of("xsens"), extras=False)), person(1.0, 30)
    frames = Rotation.random(made.skeleton.num_joints, rng=3)
    turned = dict(zip(made.skeleton.names, frames, strict=True))
    offsets = [made.skeleton.offsets[0]] + [
        torch.from_numpy(frames[p].inv().apply(made.skeleton.offsets[j].numpy()))
        for j, p in enumerate(made.skeleton.parents)
        if p >= 0
    ]
    still = torch.tensor([0.0, 0, 0, 1]).double().expand(1, 21, 4)
    begins = replace(wanted, root_position=wanted.root_position[:1], local_quat_xyzw=still).join(wanted)
    strange = replace(
        made,
        skeleton=replace(made.skeleton, offsets=torch.stack(offsets), end_offsets={}),
        tpose={c: turned[own] for c, own in made.joint.items()},
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


def frozen_conversion(motion, rig):
    """The conversion of the two rigs that the bundled priors were trained through, as it was then."""
    joint_of = [motion.skeleton.index(rig.joints[c]) if c in rig.joints else None for c in CANONICAL.names]
    picked, world = [], motion.joint_rotations()
    for index, (name, joint) in enumerate(zip(CANONICAL.names, joint_of, strict=True)):
        axes, matrix = rig.tpose.get(name), torch.eye(3, dtype=torch.float64)
        if axes:
            x, y = (torch.tensor(axes[axis], dtype=torch.float64) for axis in ("x", "y"))
            x = torch.nn.functional.normalize(x, dim=0)
            y = torch.nn.functional.normalize(y - x * (x @ y), dim=0)
            matrix = torch.stack([x, y, torch.linalg.cross(x, y)], dim=1)
        if rig.name == "cmu-daz" and name.endswith(("UpperArm", "LowerArm", "UpperLeg", "LowerLeg")):
            child = CANONICAL.children(index)[0]
            bone = torch.nn.functional.normalize(motion.skeleton.offsets[joint_of[child]], dim=0)
            aim = torch.nn.functional.normalize(CANONICAL.offsets[child], dim=0)
            axis, cosine = torch.linalg.cross(bone, aim), bone @ aim
            sine = axis.norm().clamp_min(1e-12)
            matrix = rotations.rotation_vector_to_matrix(axis / sine * torch.atan2(sine, cosine))
        tpose = rotations.from_matrix(matrix)
        if joint is None:
            picked.append(picked[CANONICAL.parents[index]])
        else:
            picked.append(rotations.multiply(world[:, joint], rotations.inverse(tpose).expand(len(world), 4)))
    local = kinematics.local_from_world(CANONICAL.parents, torch.stack(picked, dim=1))
    return rotations.make_sign_continuous(local), motion.joint_positions()[:, joint_of[0]]


@pytest.mark.parametrize(("name", "skeleton"), [("bandai-namco", bandai_skeleton()), ("cmu-daz", cmu_skeleton())])
def test_the_rigs_that_priors_were_trained_through_convert_as_they_did(name, skeleton):
    motion = retarget.from_canonical(walk(20), retarget.identify_rig(skeleton))
    canonical, rigmap = retarget.to_canonical(motion)
    local, hips = frozen_conversion(motion, retarget.load_rig(name))
    assert rigmap.rig.name == name
    torch.testing.assert_close(canonical.local_quat_xyzw, local, atol=1e-12, rtol=0)
    assert torch.equal(canonical.root_position, hips)


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
    made, wanted, motion, *_ = converted(Make(INVENTED, zup=True, arms_down_deg=20))
    path = tmp_path / "ours.toml"
    path.write_text(TOML.format(up="z", rest="straighten", facing="-y", unit="cm"))
    rig = retarget.load_rig(path)
    assert (rig.name, rig.up, rig.metres_per_unit) == ("ours", "z", 0.01)
    canonical, rigmap = retarget.to_canonical(motion, rig)
    assert rigmap.rig is rig
    assert_understood(made, wanted, canonical, rigmap)
    path.write_text(TOML.format(up="y", rest="tpose", facing="auto", unit="m"))
    canonical, rigmap = retarget.to_canonical(motion, retarget.load_rig(path))
    assert (rigmap.up, rigmap.tpose_from) == ("y", "table")
    assert_returns(motion, canonical, rigmap)


def test_a_unit_that_is_set_wins(tmp_path):
    motion = make(Make(names_of("mixamo"))).motion(person(1.0, 5))
    motion.save(tmp_path / "a.bvh")
    found = mapctl.load(tmp_path / "a.bvh")
    inches = mapctl.load(tmp_path / "a.bvh", metres_per_unit=0.0254)
    assert (bvh.unit_of(found), bvh.unit_of(inches), bvh.unit_of(motion)) == (0.01, 0.0254, None)
    torch.testing.assert_close(inches.joint_positions(), 2.54 * found.joint_positions())
    inches.save(tmp_path / "b.bvh")
    torch.testing.assert_close(mapctl.load(tmp_path / "b.bvh").root_position, found.root_position, atol=1e-6, rtol=0)
