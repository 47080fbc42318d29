"""Characters of USD: read as rigs and clips, and written back, as usd-core sees them."""

import shutil
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from forked_readers import fork_readers
from helpers import random_motion, walk

pytest.importorskip("pxr", reason="needs usd-core: pip install 'mapctl[usd]'")

from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, UsdUtils
from usd_maker import COLOURS, JOINTS, make_character_usd
from usd_viewer import UsdViewer, find_faults

from mapctl import formats, rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.retarget import figure
from mapctl.retarget.carry import RiggedCharacter, retarget_motion

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
def forked():
    with fork_readers():
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
    places, turns = (
        motion.joint_positions()[frame].numpy(),
        rotations.to_matrix(motion.joint_rotations()[frame]).numpy(),
    )
    return mesh.pose(places, turns)[0]


def follow_up(path):
    """Another motion on the character that a file holds."""
    body = RiggedCharacter.of(figure.load_standing_character(path))[1]
    return body.on_rig(retarget_motion(walk(12), body).motion)


def animations_of(viewer):
    return sorted(prim.GetName() for prim in viewer.prims if prim.IsA(UsdSkel.Animation))


class TestReading:
    def test_a_clip_is_where_usd_has_it(self, kind, tmp_path):
        path = make(tmp_path, kind, ENDINGS[len(kind) % 3], frames=9)
        motion, viewer = formats.load(path), UsdViewer(path)
        assert motion.skeleton.names == JOINTS
        assert (motion.fps, motion.num_frames) == (30, 9)
        for frame in range(9):
            np.testing.assert_allclose(motion.joint_positions()[frame], viewer.joints(frame), **NEAR)
        assert not motion.moving_offsets

    def test_the_mesh_is_skinned_as_usd_does(self, kind, tmp_path):
        path = make(tmp_path, kind, frames=9)
        motion, mesh, viewer = formats.load(path), formats.load_mesh(path), UsdViewer(path)
        assert mesh.faces.shape == (len(viewer.meshes[0].GetPrim().GetAttribute("faceVertexCounts").Get()), 3)
        for frame in (0, 8):
            np.testing.assert_allclose(skinned(mesh, motion, frame), viewer.vertices(frame), **NEAR)
        for colour in COLOURS.values():
            linear = np.where(mesh.rgba <= 0.04045, mesh.rgba / 12.92, ((mesh.rgba + 0.055) / 1.055) ** 2.4)[:, :3]
            assert (np.abs(linear - colour).max(axis=1) < 1e-4).sum() > 50

    def test_the_rest_pose_is_that_of_the_skin(self, tmp_path):
        path = make(tmp_path, "posed-rest", frames=3)
        rest, mesh = formats.load_rest(path), formats.load_mesh(path)
        assert rest.num_frames == 1
        assert (rest.local_quat_xyzw[0, :, 3].abs() > 1 - 1e-9).all()
        arm = rest.joint_positions()[0, rest.skeleton.index("leftHand")]
        assert abs(float(arm[1] - rest.joint_positions()[0, rest.skeleton.index("leftShoulder")][1])) < 0.1
        np.testing.assert_allclose(mesh.rest, rest.joint_positions()[0], atol=1e-9)

    def test_without_a_bind_pose_it_is_the_skeletons_rest_pose(self, tmp_path):
        path = make(tmp_path, "posed-rest", bind=False, frames=5)
        motion, rest, viewer = formats.load(path), formats.load_rest(path), UsdViewer(path)
        np.testing.assert_allclose(motion.joint_positions()[4], viewer.joints(4), **NEAR)
        bent = np.array(viewer.query.ComputeJointSkelTransforms(0, atRest=True))[:, 3, :3]
        np.testing.assert_allclose(rest.joint_positions()[0], viewer._to_world(bent, 0), **NEAR)

    def test_without_an_animation_it_is_the_rest_pose(self, tmp_path):
        path = make(tmp_path, "plain")
        assert formats.load(path).num_frames == 1
        assert formats.load(path).source.animation is None

    def test_a_last_joint_may_mirror(self, tmp_path):
        path = make(tmp_path, "plain", frames=9)
        plain = formats.load(path)
        stage = Usd.Stage.Open(str(path))
        skeleton = UsdSkel.Skeleton(next(prim for prim in stage.Traverse() if prim.IsA(UsdSkel.Skeleton)))
        mirror, toes = Gf.Matrix4d(Gf.Vec4d(1, 1, -1, 1)), JOINTS.index("leftToes")
        for attribute in (skeleton.GetRestTransformsAttr(), skeleton.GetBindTransformsAttr()):
            matrices = attribute.Get()
            matrices[toes] = mirror * matrices[toes]
            attribute.Set(matrices)
        stage.Save()
        motion = formats.load(path)
        np.testing.assert_allclose(motion.joint_positions(), plain.joint_positions(), **NEAR)
        np.testing.assert_allclose(motion.joint_rotations(), plain.joint_rotations(), **NEAR)
        motion.save(tmp_path / "new.usda")
        again = formats.load(tmp_path / "new.usda")
        np.testing.assert_allclose(again.joint_rotations(), motion.joint_rotations(), **NEAR)

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
    def test_time_codes_become_frames(self, tmp_path, rate, step, start, fps, frames):
        path = make(tmp_path, "plain", frames=5, rate=rate, step=step, start=start)
        motion, viewer = formats.load(path), UsdViewer(path)
        assert (motion.fps, motion.num_frames) == (fps, frames)
        for frame in range(frames):
            wanted = viewer.joints(start + frame * rate / float(fps))
            np.testing.assert_allclose(motion.joint_positions()[frame], wanted, rtol=0, atol=1e-4)

    @pytest.mark.slow
    def test_several_are_told_by_name(self, tmp_path):
        path = make(tmp_path, "plain", names=("Body", "Horse"), frames=4)
        with pytest.raises(FileFormatError, match=r"2 armatures: 'Body', 'Horse'; choose one, as hero.usda#Body"):
            formats.load(path)
        with pytest.raises(FileFormatError, match="no armature 'Cow'; it has 'Body', 'Horse'"):
            formats.load(f"{path}#Cow")
        horse = formats.load(f"{path}#Horse/wild")
        np.testing.assert_allclose(horse.joint_positions()[2], UsdViewer(path, 1).joints(2), **NEAR)
        with pytest.raises(FileFormatError, match="no animation 'Run'; it has 'wild'"):
            formats.load(f"{path}#Horse/Run")

    def test_an_animation_that_is_not_bound_is_read_by_name(self, tmp_path):
        path = make(tmp_path, "plain", frames=4)
        wanted = formats.load(path).joint_positions()
        stage = Usd.Stage.Open(str(path))
        stage.GetPrimAtPath("/World/BodyRoot/Body").GetRelationship("skel:animationSource").ClearTargets(True)
        stage.GetRootLayer().Save()
        assert formats.load(path).num_frames == 1
        np.testing.assert_array_equal(formats.load(f"{path}#/wild").joint_positions(), wanted)

    def test_composed_stages(self, tmp_path):
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

    def test_value_clips_in_the_files_folder(self, tmp_path):
        path = make(tmp_path, "plain", frames=4)
        wanted = formats.load(path).joint_positions()
        stage = Usd.Stage.Open(str(path))
        clip = Sdf.Layer.CreateNew(str(tmp_path / "clip.1.usda"))
        clip.TransferContent(stage.GetRootLayer())
        clip.Save()
        wild = stage.GetPrimAtPath("/World/BodyRoot/Body/wild")
        for name in ("rotations", "translations"):
            wild.GetAttribute(name).Clear()
        api = Usd.ClipsAPI(wild)
        api.SetClipAssetPaths(["./clip.1.usda"])
        api.SetClipPrimPath("/World/BodyRoot/Body/wild")
        api.SetClipActive([(0, 0)])
        api.SetClipTimes([(0, 0), (3, 3)])
        api.SetClipManifestAssetPath("./clip.1.usda")
        stage.GetRootLayer().Save()
        found = formats.load(path)
        np.testing.assert_allclose(found.joint_positions()[[0, -1]], wanted[[0, 3]], **NEAR)

    def test_packages(self, tmp_path):
        path = make(tmp_path, "centimetres", ".usdc", frames=5)
        assert UsdUtils.CreateNewUsdzPackage(str(path), str(tmp_path / "hero.usdz"))
        wanted = formats.load(path)
        np.testing.assert_array_equal(formats.load(tmp_path / "hero.usdz").joint_positions(), wanted.joint_positions())

    def test_several_roots_get_one_above(self, tmp_path):
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

    def test_names_are_paths_where_leaves_repeat(self, tmp_path):
        path = make(tmp_path, "plain")
        text = path.read_text().replace("rightHand", "leftHand")
        path.write_text(text)
        assert (
            "hips/spine/spine1/chest/rightShoulder/rightUpperArm/rightLowerArm/leftHand"
            in formats.load(path).skeleton.names
        )


class TestWriting:
    @pytest.mark.slow
    def test_another_motion_on_the_same_character(self, kind, tmp_path):
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
    def test_all_else_stays(self, kind, tmp_path):
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

    def test_the_animation_that_was_read_is_replaced(self, tmp_path):
        path, out = make(tmp_path, "morphs", frames=6), tmp_path / "out.usdc"
        motion = formats.load(path)
        changed = replace(motion, root_position=motion.root_position + 0.5)
        changed.save(out)
        assert_same(changed, UsdViewer(out))
        assert animations_of(UsdViewer(out)) == ["wild"]
        stages = [UsdViewer(file).stage for file in (out, path)]
        weights = [s.GetAttributeAtPath("/World/BodyRoot/Body/wild.blendShapeWeights") for s in stages]
        assert [list(weights[0].Get(k)) for k in range(6)] == [list(weights[1].Get(k)) for k in range(6)]

    def test_a_shorter_motion_leaves_no_old_samples(self, tmp_path):
        path, out = make(tmp_path, "plain", frames=9), tmp_path / "out.usda"
        motion = formats.load(path).slice(2, 5)
        motion.save(out)
        viewer = UsdViewer(out)
        for name in ("translations", "rotations"):
            wild = viewer.stage.GetAttributeAtPath(f"/World/BodyRoot/Body/wild.{name}")
            assert wild.GetTimeSamples() == [0, 1, 2]
        assert_same(motion, viewer)

    def test_the_extent_is_that_of_the_motion(self, tmp_path):
        path, out = make(tmp_path, "z-up", unit=0.01), tmp_path / "out.usda"
        motion = follow_up(path)
        far = replace(motion, root_position=motion.root_position + 40.0)
        far.save(out)
        viewer = UsdViewer(out)
        root = UsdSkel.Root.Find(viewer.skeleton).GetPrim()
        box = np.array(root.GetAttribute("extent").Get())
        ends = viewer._to_world(np.array(np.meshgrid(*box.T)).reshape(3, -1).T, 0)
        places = far.joint_positions().reshape(-1, 3).numpy()
        assert (ends.min(0) < places.min(0) - 0.29).all()
        assert (ends.max(0) > places.max(0) + 0.29).all()
        assert (np.ptp(ends, axis=0) < 5.0).all()

    @pytest.mark.slow
    def test_other_animations_stay_beside(self, tmp_path):
        path, out = make(tmp_path, "plain", frames=6), tmp_path / "2 steps.usda"
        follow_up(path).save(out)
        assert animations_of(UsdViewer(out)) == ["_2_steps", "wild"]
        assert formats.load(out).source.animation == "_2_steps"
        np.testing.assert_allclose(
            formats.load(f"{out}#/wild").joint_positions(), formats.load(path).joint_positions(), **NEAR
        )

    def test_what_else_moves_keeps_its_time(self, tmp_path):
        path, out = make(tmp_path, "plain", crate=True, rate=24.0), tmp_path / "out.usda"
        motion = follow_up(path)
        motion.save(out)
        viewer = UsdViewer(out)
        assert viewer.stage.GetTimeCodesPerSecond() == 24
        assert viewer.stage.GetPrimAtPath("/World/Crate").GetAttribute("size").Get(3) == 4.0
        assert_same(motion, viewer)
        assert formats.load(out).fps == motion.fps

    @pytest.mark.slow
    def test_layers_stay_where_the_new_file_finds_them(self, tmp_path):
        (tmp_path / "parts").mkdir()
        make_character_usd(tmp_path / "parts" / "body.usda")
        stage = Usd.Stage.CreateNew(str(tmp_path / "hero.usda"))
        prim = UsdGeom.Xform.Define(stage, "/hero").GetPrim()
        prim.GetReferences().AddReference("./parts/body.usda")
        prim.SetInstanceable(True)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, "Y")
        stage.GetRootLayer().Save()
        motion = follow_up(tmp_path / "hero.usda")
        (tmp_path / "other").mkdir()
        for out in (tmp_path / "out.usda", tmp_path / "other" / "out.usda"):
            motion.save(out)
            assert_same(motion, UsdViewer(out))
            assert ("parts/body.usda" in out.read_text()) == (out.parent == tmp_path)
            np.testing.assert_allclose(formats.load(out).joint_positions(), motion.joint_positions(), **NEAR)

    def test_a_package_becomes_one_layer(self, tmp_path):
        path = make(tmp_path, "centimetres", ".usdc")
        assert UsdUtils.CreateNewUsdzPackage(str(path), str(tmp_path / "pack.usdz"))
        motion = follow_up(tmp_path / "pack.usdz")
        motion.save(tmp_path / "out.usda")
        assert_same(motion, UsdViewer(tmp_path / "out.usda"))
        with pytest.raises(RequestError, match=r"\.usdz is read but not written"):
            motion.save(tmp_path / "out.usdz")

    def test_a_changed_file_is_refused(self, tmp_path):
        path = make(tmp_path, "plain")
        motion = follow_up(path)
        path.write_text(path.read_text() + "\n")
        with pytest.raises(RequestError, match="has changed since it was read"):
            motion.save(tmp_path / "out.usda")
        assert [file.name for file in tmp_path.iterdir()] == ["hero.usda"]

    def test_the_mannequin_passes_the_checks(self, tmp_path):
        random_motion(walk(5).skeleton, 6, seed=3).save(tmp_path / "walk.usda")
        assert find_faults(tmp_path / "walk.usda") == []


@pytest.mark.slow
def test_follow_from_the_command_line(tmp_path):
    path = make(tmp_path, "centimetres", ".usdc", blend_shape=True)
    out = tmp_path / "hero-walk.usda"
    words = [sys.executable, "-m", "mapctl", "convert", "walk.bvh", str(out), "--rig", path.name]
    walk(20).save(tmp_path / "walk.bvh")
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert_same(formats.load(out), UsdViewer(out))
    assert find_faults(out) == find_faults(path)
    shutil.copy(out, tmp_path / "again.usda")
