"""Characters of USD: read as rigs and clips, and written back, as usd-core sees them; and motions on a mannequin."""

import re
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from direct_readers import read_directly
from helpers import random_motion, walk

pytest.importorskip("pxr", reason="needs usd-core: pip install 'mapctl[usd]'")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel
from usd_maker import COLOURS, JOINTS, make_character_usd
from usd_viewer import UsdViewer, find_faults

from mapctl import cli, formats, rotations
from mapctl.errors import FileFormatError
from mapctl.formats import usd
from mapctl.mesh.mannequin import build_skin
from mapctl.retarget import character
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.skeleton import CANONICAL, Skeleton

KINDS = {
    "plain": {},
    "z-up": {"up": "Z", "placed": "moved"},
    "centimetres": {"unit": 0.01, "pose": "A"},
    "posed-rest": {"rest_pose": "bent", "placed": "moved", "unit": 0.01},
    "aligned": {"along_y": False},
    "animated-above": {"placed": "animated", "up": "Z"},
    "morphs": {"blend_shape": True, "pose": "A"},
}


ENDINGS = (".usda", ".usdc", ".usd")


NEAR = dict(rtol=0, atol=1e-5)  # UsdSkel computes in 32 bits where a file has them


@pytest.fixture(autouse=True)
def direct():
    with read_directly():
        yield


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def make(folder, kind, ending=".usda", **more):
    path = folder / f"hero{ending}"
    make_character_usd(path, **(KINDS[kind] | more))
    return path


def assert_same(motion, viewer, first=0):
    """The motion's joints, from `first` on, are where the viewer has them."""
    codes = viewer.times(float(motion.fps))
    assert motion.num_frames == len(codes)
    for frame, code in enumerate(codes):
        np.testing.assert_allclose(motion.joint_positions()[frame, first:], viewer.joints(code), **NEAR)


def skinned(mesh, motion, frame):
    positions, turns = (
        motion.joint_positions()[frame].numpy(),
        rotations.to_matrix(motion.joint_rotations()[frame]).numpy(),
    )
    return mesh.pose(positions, turns)[0]


def follow_up(path):
    """Another motion on the character that a file holds."""
    body = RiggedCharacter.of(character.load_standing_character(path))[1]
    return body.on_rig(retarget_motion(walk(12), body).motion)


def animations_of(viewer):
    return sorted(prim.GetName() for prim in viewer.prims if prim.IsA(UsdSkel.Animation))


def test_a_clip_is_where_usd_has_it(kind, tmp_path):
    path = make(tmp_path, kind, ENDINGS[len(kind) % 3], frames=9)
    motion, viewer = formats.load(path), UsdViewer(path)
    assert motion.skeleton.names == JOINTS
    assert (motion.fps, motion.num_frames) == (30, 9)
    for frame in range(9):
        np.testing.assert_allclose(motion.joint_positions()[frame], viewer.joints(frame), **NEAR)
    assert not motion.moving_offsets


def test_the_mesh_is_skinned_as_usd_does(kind, tmp_path):
    path = make(tmp_path, kind, frames=9)
    motion, mesh, viewer = formats.load(path), formats.load_mesh(path), UsdViewer(path)
    assert mesh.faces.shape == (len(viewer.meshes[0].GetPrim().GetAttribute("faceVertexCounts").Get()), 3)
    for frame in (0, 8):
        np.testing.assert_allclose(skinned(mesh, motion, frame), viewer.vertices(frame), **NEAR)
    for colour in COLOURS.values():
        linear = np.where(mesh.rgba <= 0.04045, mesh.rgba / 12.92, ((mesh.rgba + 0.055) / 1.055) ** 2.4)[:, :3]
        assert (np.abs(linear - colour).max(axis=1) < 1e-4).sum() > 50


def test_without_a_bind_pose_it_is_the_skeletons_rest_pose(tmp_path):
    path = make(tmp_path, "posed-rest", bind=False, frames=5)
    motion, rest, viewer = formats.load(path), formats.load_rest(path), UsdViewer(path)
    np.testing.assert_allclose(motion.joint_positions()[4], viewer.joints(4), **NEAR)
    bent = np.array(viewer.query.ComputeJointSkelTransforms(0, atRest=True))[:, 3, :3]
    np.testing.assert_allclose(rest.joint_positions()[0], viewer._to_world(bent, 0), **NEAR)


@pytest.mark.parametrize(
    ("rate", "step", "start", "fps", "frames"),
    [
        (24.0, 1.0, 1.0, Fraction(24), 5),
        (24.0, 2.0, 0.0, Fraction(24), 9),
        (30000 / 1001, 1.0, 100.0, Fraction(30000, 1001), 5),
        (24.0, 0.8, 0.0, Fraction(30), 5),
        (4800.0, 160.0, 0.0, Fraction(30), 5),
        (60.0, 1.0, -3.0, Fraction(60), 5),
    ],
)
def test_time_codes_become_frames(tmp_path, rate, step, start, fps, frames):
    path = make(tmp_path, "plain", frames=5, rate=rate, step=step, start=start)
    motion, viewer = formats.load(path), UsdViewer(path)
    assert (motion.fps, motion.num_frames) == (fps, frames)
    for frame in range(frames):
        wanted = viewer.joints(start + frame * rate / float(fps))
        np.testing.assert_allclose(motion.joint_positions()[frame], wanted, rtol=0, atol=1e-4)


def test_composed_stages(tmp_path):
    """A reference in an instance, in a layer below the file's folder."""
    (tmp_path / "parts").mkdir()
    make_character_usd(tmp_path / "parts" / "body.usdc", frames=5, unit=0.01, up="Z")
    stage = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(30)
    prim = UsdGeom.Xform.Define(stage, "/hero").GetPrim()
    prim.GetReferences().AddReference("./parts/body.usdc")
    prim.SetInstanceable(True)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(4)
    stage.GetRootLayer().Save()
    assert_same(formats.load(tmp_path / "hero.usda"), UsdViewer(tmp_path / "hero.usda"))
    assert len(formats.load_mesh(tmp_path / "hero.usda").faces) > 500


def test_several_roots_get_one_above(tmp_path):
    path = make(tmp_path, "plain", frames=4)
    stage = Usd.Stage.Open(str(path))
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/World/BodyRoot/Body"))
    add = {"Joints": ["prop"], "BindTransforms": [Gf.Matrix4d(1.0)], "RestTransforms": [Gf.Matrix4d(1.0)]}
    for name, more in add.items():
        attribute = getattr(skeleton, f"Get{name}Attr")()
        attribute.Set(list(attribute.Get()) + more)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(3)
    stage.GetRootLayer().Save()
    motion = formats.load(path)
    assert motion.skeleton.names == ("Body", *JOINTS, "prop")
    assert_same(motion, UsdViewer(path), first=1)
    replace(motion, root_position=motion.root_position + 1.0).save(tmp_path / "out.usda")
    moved = UsdViewer(tmp_path / "out.usda")
    np.testing.assert_allclose(moved.joints(2), UsdViewer(path).joints(2) + 1.0, **NEAR)


@pytest.mark.slow
def test_another_motion_on_the_same_character(kind, tmp_path):
    path, out = make(tmp_path, kind), tmp_path / f"hero-walk{ENDINGS[len(kind) % 3]}"
    motion = follow_up(path)
    motion.save(out)
    assert_same(motion, UsdViewer(out))
    mesh, viewer = formats.load_mesh(path), UsdViewer(out)
    code = viewer.times(float(motion.fps))[7]
    np.testing.assert_allclose(skinned(mesh, motion, 7), viewer.vertices(code), **NEAR)
    again = formats.load(out)
    assert again.source.animation == "hero_walk"
    np.testing.assert_allclose(again.joint_positions(), motion.joint_positions(), **NEAR)
    assert find_faults(out) == find_faults(path)


@pytest.mark.slow
def test_all_else_stays(kind, tmp_path):
    path, out = make(tmp_path, kind), tmp_path / "out.usda"
    follow_up(path).save(out)
    before, after = (Sdf.Layer.OpenAsAnonymous(str(file)) for file in (path, out))
    after.GetPrimAtPath("/World/BodyRoot/Body").nameChildren.__delitem__("out")
    old, new = before.GetPrimAtPath("/World/BodyRoot"), after.GetPrimAtPath("/World/BodyRoot")
    new.attributes["extent"].default = old.attributes["extent"].default
    skeleton = after.GetPrimAtPath("/World/BodyRoot/Body")
    skeleton.RemoveProperty(skeleton.relationships["skel:animationSource"])
    skeleton.ClearInfo("apiSchemas")
    for layer in (before, after):
        for key in ("timeCodesPerSecond", "framesPerSecond", "startTimeCode", "endTimeCode"):
            layer.pseudoRoot.ClearInfo(key)
    assert after.ExportToString() == before.ExportToString()


def test_the_animation_that_was_read_is_replaced(tmp_path):
    path, out = make(tmp_path, "morphs", frames=6), tmp_path / "out.usdc"
    motion = formats.load(path)
    changed = replace(motion, root_position=motion.root_position + 0.5)
    changed.save(out)
    assert_same(changed, UsdViewer(out))
    assert animations_of(UsdViewer(out)) == ["wild"]
    stages = [UsdViewer(file).stage for file in (out, path)]
    weights = [s.GetAttributeAtPath("/World/BodyRoot/Body/wild.blendShapeWeights") for s in stages]
    assert [list(weights[0].Get(k)) for k in range(6)] == [list(weights[1].Get(k)) for k in range(6)]


def test_a_shorter_motion_leaves_no_old_samples(tmp_path):
    path, out = make(tmp_path, "plain", frames=9), tmp_path / "out.usda"
    motion = formats.load(path).slice(2, 5)
    motion.save(out)
    viewer = UsdViewer(out)
    for name in ("translations", "rotations"):
        wild = viewer.stage.GetAttributeAtPath(f"/World/BodyRoot/Body/wild.{name}")
        assert wild.GetTimeSamples() == [0, 1, 2]
    assert_same(motion, viewer)


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_mannequin_moves_as_the_motion(tmp_path, ending):
    motion = random_motion(CANONICAL, 12, seed=4, fps=Fraction(30000, 1001))
    motion.save(tmp_path / f"walk{ending}")
    viewer, body = UsdViewer(tmp_path / f"walk{ending}"), build_skin(motion)
    assert viewer.query.GetTopology().GetParentIndices() == list(CANONICAL.parents)
    matrices, positions = rotations.to_matrix(motion.joint_rotations()).numpy(), motion.joint_positions().numpy()
    for frame in (0, 7, 11):
        np.testing.assert_allclose(viewer.joints(frame), positions[frame], atol=2e-6)
        expected, _ = body.pose(positions[frame], matrices[frame])
        np.testing.assert_allclose(viewer.vertices(frame), expected, atol=5e-6)
    assert find_faults(tmp_path / f"walk{ending}") == []


def test_names_become_paths_of_letters_and_digits():
    names = ("mixamorig:Hips", "a b", "a_b", "2 legs", "Füße", "a-b")
    skeleton = Skeleton(names, (-1, 0, 0, 0, 1, 0), CANONICAL.offsets[:6])
    assert usd.joint_paths(skeleton) == [
        "mixamorig_Hips",
        "mixamorig_Hips/a_b",
        "mixamorig_Hips/a_b_2",
        "mixamorig_Hips/_2_legs",
        "mixamorig_Hips/a_b/F__e",
        "mixamorig_Hips/a_b_3",
    ]


SCALED = 'float3 xformOp:scale = ({})\nuniform token[] xformOpOrder = ["xformOp:scale"]\nfloat3[] extent'


CLIPS = '(\nclips = {{ dictionary default = {{ string templateAssetPath = "{}" }} }} )'


BAD = {
    "no skeleton": (r"def SkelRoot.*", "}", "has no Skeleton"),
    "no usd": (r".*", "hello", "is no sound USD file"),
    "cut off": (r"def Mesh.*", "", "is no sound USD file"),
    "uneven scale": (r"float3\[\] extent", SCALED.format("1, 2, 1"), "not the same along all axes"),
    "negative scale": (r"float3\[\] extent", SCALED.format("-1, 1, 1"), "negative"),
    "missing layer": (r"\(\n", "(\nsubLayers = [@./gone.usda@]\n", "'./gone.usda', which is not there"),
    "outside": (r"\(\n", "(\nsubLayers = [@../out.usda@]\n", "not in its folder"),
    "absolute": (r"\(\n", "(\nsubLayers = [@/etc/hosts.usda@]\n", "not in its folder"),
    "web": (r"\(\n", "(\nsubLayers = [@https://host/a.usda@]\n", "not in its folder"),
    "clips": (r'(SkelRoot "\w+")', r"\1 " + CLIPS.format("../c.#.usda"), "not in its folder"),
    "no unit": (r"metersPerUnit = 1", "metersPerUnit = 0", "metersPerUnit is 0"),
    "joint order": (r'\["hips", "hips/spine",', '["hips/spine", "hips",', "comes before the joint above it"),
    "two joints": (r'\["hips", "hips/spine",', '["hips", "hips",', "names a joint twice"),
}
"""Pattern in a sound file, what stands in its place, and words of the message."""


@pytest.mark.parametrize("fault", BAD)
def test_one_line_names_the_fault(fault, tmp_path, capfd):
    path = make(tmp_path, "plain", frames=2)
    pattern, instead, words = BAD[fault]
    path.write_text(re.sub(pattern, instead, path.read_text(), count=1, flags=re.DOTALL))
    (tmp_path.parent / "out.usda").write_text("#usda 1.0\n")
    out = tmp_path / "out.bvh"
    assert cli.main(["convert", str(path), str(out)]) == 2
    given = capfd.readouterr()
    assert given.err.count("\n") == 1, given.err
    assert words in given.err
    assert not given.out
    assert not out.exists()


def test_a_link_that_leads_elsewhere(tmp_path):
    (tmp_path / "a").mkdir()
    make_character_usd(tmp_path / "body.usda")
    (tmp_path / "a" / "body.usda").symlink_to(tmp_path / "body.usda")
    (tmp_path / "a" / "hero.usda").write_text("#usda 1.0\n( subLayers = [@./body.usda@] )\n")
    with pytest.raises(FileFormatError, match="not in its folder"):
        formats.load(tmp_path / "a" / "hero.usda")
