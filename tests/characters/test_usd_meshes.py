"""Meshes of USD characters: faces of any kind, and where colours come from."""

import numpy as np
import pytest

pytest.importorskip("pxr", reason="needs usd-core: pip install 'mapctl[usd]'")

from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdSkel
from usd_maker import JOINTS, make_character_usd

from mapctl import formats


def make(folder):
    make_character_usd(folder / "hero.usda")
    return folder / "hero.usda"


def test_faces_of_any_kind(tmp_path):
    """Quads and holes, left-handed, on one joint alone, with a colour of their own."""
    path = make(tmp_path)
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/BodyRoot/mesh"))
    for prim in list(mesh.GetPrim().GetChildren()):
        stage.RemovePrim(prim.GetPath())
    mesh.GetPointsAttr().Set([(0, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0), (0.5, 2.5, 0), (5, 5, 5)])
    mesh.GetFaceVertexCountsAttr().Set([5, 3, 3])
    mesh.GetFaceVertexIndicesAttr().Set([0, 1, 2, 4, 3, 0, 1, 5, 1, 2, 5])
    mesh.GetHoleIndicesAttr().Set([1])
    mesh.GetOrientationAttr().Set("leftHanded")
    mesh.CreateDisplayColorPrimvar("uniform").Set([(1, 0, 0), (0, 1, 0), (0, 0, 1)])
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    binding.CreateJointIndicesPrimvar(True, 1).Set([JOINTS.index("head")])
    binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    stage.GetRootLayer().Save()
    found = formats.load_mesh(path)
    assert found.faces.tolist() == [[2, 1, 0], [4, 2, 0], [3, 4, 0], [5, 2, 1]]
    assert set(found.joints.reshape(-1)) == {JOINTS.index("head")}
    np.testing.assert_allclose(found.rgba[3], [1, 0, 0, 1], atol=1e-12)
    assert found.rgba[5, 0] < found.rgba[5, 2]


@pytest.mark.slow
def test_a_picture_is_seen_at_the_vertices(tmp_path):
    pillow = pytest.importorskip("PIL.Image")
    pillow.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8).repeat(2, axis=0)).save(tmp_path / "a.png")
    path = make(tmp_path)
    stage = Usd.Stage.Open(str(path))
    mesh = stage.GetPrimAtPath("/World/BodyRoot/mesh")
    points = np.array(mesh.GetAttribute("points").Get())
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    st.Set(np.where(points[:, :1] > 0, [[0.75, 0.5]], [[0.25, 0.5]]).tolist())
    picture = UsdShade.Shader.Define(stage, "/World/BodyRoot/picture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./a.png")
    shader = UsdShade.Shader(stage.GetPrimAtPath("/World/BodyRoot/shirt_look/surface"))
    output = picture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shader.GetInput("diffuseColor").ConnectToSource(output)
    stage.GetRootLayer().Save()
    found = formats.load_mesh(path)
    shirt = np.unique(found.faces[np.array(stage.GetAttributeAtPath("/World/BodyRoot/mesh/shirt.indices").Get())])
    sides = found.rgba[shirt], points[shirt, 0] > 0
    assert (sides[0][sides[1]] == (0, 0, 1, 1)).all()
    assert (sides[0][~sides[1]] == (1, 0, 0, 1)).all()
