"""USD out: what USD's own library computes from the file is where the body is."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from helpers import bandai_skeleton, random_motion, walk

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats import usd
from mapctl.mesh.skinning import build_skin
from mapctl.skeleton import CANONICAL, Skeleton

needs_usd = pytest.mark.skipif(not usd.is_installed(), reason="needs usd-core: pip install 'mapctl[usd]'")


@pytest.fixture(scope="module")
def motion():
    return random_motion(CANONICAL, 12, seed=4, fps=Fraction(30000, 1001))


class Viewer:
    """A stage as a viewer sees it, by UsdSkel."""

    def __init__(self, path):
        from pxr import Usd, UsdSkel

        self.stage = Usd.Stage.Open(str(path))
        top = UsdSkel.Root(self.stage.GetDefaultPrim())
        cache = UsdSkel.Cache()
        cache.Populate(top, Usd.TraverseInstanceProxies())
        (found,) = cache.ComputeSkelBindings(top, Usd.TraverseInstanceProxies())
        (self.mesh,) = found.GetSkinningTargets()
        self.skeleton = cache.GetSkelQuery(found.GetSkeleton())
        self.names = list(found.GetSkeleton().GetJointNamesAttr().Get())

    def joints(self, frame):
        """(joints, 3) world places; the character itself is not moved."""
        return np.array(self.skeleton.ComputeJointSkelTransforms(frame))[:, 3, :3]

    def skinned(self, frame):
        """(n, 3) vertices of the mesh."""
        points = self.mesh.GetPrim().GetAttribute("points").Get()
        assert self.mesh.ComputeSkinnedPoints(self.skeleton.ComputeSkinningTransforms(frame), points, frame)
        return np.array(points)


@needs_usd
@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usd"])
def test_joints_and_skin_are_where_the_motion_says(motion, tmp_path, ending):
    motion.save(tmp_path / f"walk{ending}")
    viewer, body = Viewer(tmp_path / f"walk{ending}"), build_skin(motion)
    assert viewer.skeleton.GetTopology().Validate()[0]
    assert viewer.skeleton.GetTopology().GetParentIndices() == list(CANONICAL.parents)
    assert viewer.names == list(CANONICAL.names)
    matrices, places = rotations.to_matrix(motion.joint_rotations()).numpy(), motion.joint_positions().numpy()
    for frame in (0, 7, 11):
        np.testing.assert_allclose(viewer.joints(frame), places[frame], atol=2e-6)
        expected = np.einsum("nij,nj->ni", matrices[frame, body.joint], body.vertices) + places[frame, body.joint]
        np.testing.assert_allclose(viewer.skinned(frame), expected, atol=5e-6)


@needs_usd
def test_a_joint_that_travels_and_a_foreign_rig(tmp_path):
    motion = random_motion(bandai_skeleton(), 5, seed=2)
    motion = replace(motion, moving_offsets={1: motion.root_position.flip(0)})
    motion.save(tmp_path / "walk.usda")
    viewer = Viewer(tmp_path / "walk.usda")
    for frame in range(5):
        np.testing.assert_allclose(viewer.joints(frame), motion.joint_positions()[frame], atol=2e-6)


@needs_usd
def test_the_stage_says_units_axis_and_time(motion, tmp_path):
    from pxr import UsdGeom

    motion.save(tmp_path / "walk.usda")
    stage = Viewer(tmp_path / "walk.usda").stage
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Y")
    assert stage.GetTimeCodesPerSecond() == pytest.approx(30000 / 1001, abs=1e-9)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 11)
    turns = stage.GetPrimAtPath("/character/motion").GetAttribute("rotations")
    assert turns.GetTimeSamples() == list(range(12))
    quats = np.array([[[*q.GetImaginary(), q.GetReal()] for q in turns.Get(frame)] for frame in range(12)])
    assert np.allclose(np.linalg.norm(quats, axis=-1), 1, atol=1e-6)
    assert ((quats[1:] * quats[:-1]).sum(-1) >= 0).all()


@needs_usd
def test_same_motion_same_bytes(motion, tmp_path):
    for ending in (".usda", ".usdc"):
        files = [tmp_path / f"{name}{ending}" for name in "ab"]
        for file in files:
            motion.save(file)
        assert files[0].read_bytes() == files[1].read_bytes()


@needs_usd
def test_one_frame_that_stands_still(tmp_path):
    motion = walk(1)
    motion.save(tmp_path / "walk.usda")
    np.testing.assert_allclose(Viewer(tmp_path / "walk.usda").joints(0), motion.joint_positions()[0], atol=2e-6)


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


@needs_usd
def test_nan_is_refused(motion, tmp_path):
    broken = replace(motion, root_position=motion.root_position * float("nan"))
    with pytest.raises(RequestError, match="no finite position"):
        broken.save(tmp_path / "x.usda")
    with pytest.raises(RequestError, match="does not exist"):
        motion.save(tmp_path / "gone" / "x.usda")
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_named_before_any_work(motion, tmp_path, monkeypatch):
    monkeypatch.setattr(usd, "is_installed", lambda: False)
    with pytest.raises(RequestError, match=r"pip install 'mapctl\[usd\]'"):
        motion.save(tmp_path / "x.usda")
    assert not list(tmp_path.iterdir())
