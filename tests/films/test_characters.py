"""Characters in films: their mesh is where the file's matrices have it, stands on the floor, and is in the picture."""

from dataclasses import replace

import numpy as np
import pytest
from character_maker import make_character_glb
from glb_viewer import GlbViewer
from helpers import random_motion
from helpers import walk as long_walk
from scenes_walks import walk

from mapctl import formats
from mapctl.contacts import detect_contacts
from mapctl.errors import FileFormatError, MapctlError
from mapctl.mesh import colours
from mapctl.mesh.anatomy import Anatomy
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.mesh.mannequin import Body
from mapctl.retarget.carry import RiggedCharacter, retarget_motion
from mapctl.skeleton import CANONICAL, TOE_JOINTS
from scenes import renderers
from scenes.cameras import CameraSettings
from scenes.drawn_character import DrawnCharacter
from scenes.renderers import Figure, select_painter
from scenes.stage import Shot, Stage

GREY = colours.rgb("slate")
MAKES = {
    "mixamo": {"pose": "A"},
    "two-skins": {"second_skin": True, "compact": True, "extra_nodes": True, "interpolation": "CUBICSPLINE"},
    "unreal": {"names": "unreal", "root": "root", "size": 1.3, "bind": "armature", "matrices": True},
    "vrm": {"names": "vrm", "armature_scale": 1.0, "zup_armature": False, "size": 0.6},
}


def has_graphics() -> bool:
    try:
        return bool(select_painter("egl"))
    except renderers.NoGraphicsError:
        return False


needs_graphics = pytest.mark.skipif(not has_graphics(), reason="no OpenGL without a window here")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("characters")


@pytest.fixture(scope="module")
def result(folder):
    return {
        name: make_character_glb(folder / f"{name}.{'vrm' if name == 'vrm' else 'glb'}", animations=("walk",), **make)
        for name, make in MAKES.items()
    }


@pytest.fixture(scope="module")
def hero(result):
    return DrawnCharacter.load(result["mixamo"].path)


def vertices_of(body, frame: int) -> np.ndarray:
    return body.surface(frame).vertices


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKES)
def test_a_character_in_its_own_motion_is_where_its_file_has_it(result, name):
    path, viewer = result[name].path, GlbViewer(result[name].path)
    motion = formats.load(path)
    drawn = DrawnCharacter.load(path).put_on(motion)
    assert drawn.notes == ()
    assert drawn.motion is motion, "nothing is converted"
    body = drawn.build_body(motion.fps, GREY)
    for frame in (0, 7, 19, 30):
        wanted = viewer.skinned(0, frame / 30)
        np.testing.assert_allclose(vertices_of(body, frame), wanted, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKES)
def test_any_motion_is_put_on_it_as_convert_does(result, name, tmp_path):
    path, clip = result[name].path, long_walk(45)
    drawn = DrawnCharacter.load(path).put_on(clip)
    written = tmp_path / f"walk{path.suffix}"
    drawn.motion.save(written)
    viewer, body = GlbViewer(written), drawn.build_body(clip.fps, GREY)
    for frame in (0, 20, 44):
        wanted = viewer.skinned(0, frame / 30)
        np.testing.assert_allclose(vertices_of(body, frame), wanted, atol=1e-5)
    own = RiggedCharacter.of(DrawnCharacter.load(path).standing)[1]
    expected = own.on_rig(retarget_motion(clip, own).motion)
    np.testing.assert_allclose(drawn.motion.joint_positions(), expected.joint_positions(), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", MAKES)
def test_its_soles_are_on_the_floor_while_feet_are_planted(result, name):
    clip = long_walk(90)
    body = DrawnCharacter.load(result[name].path).put_on(clip).build_body(clip.fps, GREY)
    lowest = np.array([vertices_of(body, frame)[:, 1].min() for frame in range(90)])
    assert lowest.min() > -0.03
    planted = detect_contacts(clip.joint_positions()[:, TOE_JOINTS], 30).any(dim=1).numpy()
    assert planted.sum() > 30
    assert np.abs(lowest[planted]).mean() < 0.015


def test_a_motion_with_the_characters_bones_keeps_them_as_they_are(hero):
    """As `follow --rig hero.glb` solves: what the solver placed is drawn, to the micrometre."""
    solved = random_motion(hero.body.leveled, 6, seed=3)
    drawn = hero.put_on(solved)
    joints = hero.body.leveled_map.joints
    placed, wanted = drawn.motion.joint_positions(), solved.joint_positions()
    for name in ("hips", "leftLowerArm", "rightHand", "leftLowerLeg", "rightFoot"):
        np.testing.assert_allclose(placed[:, joints[name]], wanted[:, CANONICAL.index(name)], atol=1e-6)
    assert drawn.bones is solved


def test_what_is_no_character_is_refused(tmp_path):
    walk().save(tmp_path / "walk.bvh")
    with pytest.raises(FileFormatError, match=r"is no character's file"):
        DrawnCharacter.load(tmp_path / "walk.bvh")
    with pytest.raises(MapctlError):
        DrawnCharacter.load(tmp_path / "missing.glb")


@pytest.mark.slow
def test_all_of_a_character_is_in_view(folder):
    result = make_character_glb(folder / "hat.glb", hat=True)
    motion = walk(12)
    drawn = DrawnCharacter.load(result.path).put_on(motion)
    stage = Stage([Shot(motion, drawn=drawn)])
    body = stage.players[0].body
    top = vertices_of(body, 6)[:, 1].max()
    assert body.seen[6, :, 1].max() == pytest.approx(top, abs=0.02), "the hat is over the head"
    assert Anatomy(motion).seen[6, :, 1].max() < top - 0.05
    for view, frame in zip(stage.views(CameraSettings("follow"), (160, 90)), range(12), strict=True):
        at = view.project(vertices_of(body, frame))
        assert (at[:, :2] > 0).all()
        assert (at[:, :2] < [160, 90]).all()


@needs_graphics
@pytest.mark.parametrize("kind", ["follow", "fixed", "top"])
def test_its_pixels_are_where_it_is(hero, kind):
    clip = long_walk(30)
    shots = [Shot(clip, drawn=hero.put_on(clip))]
    stage, brush, size = Stage(shots), select_painter("egl"), (320, 180)
    view, content = stage.views(CameraSettings(kind), size)[15], stage.content(15)
    picture = brush.paint(view, content).astype(int)
    bare = brush.paint(view, replace(content, figures=[])).astype(int)
    red = (picture[..., 0] > 1.6 * picture[..., 1]) & (picture[..., 0] > 90) & (picture[..., 2] < picture[..., 0] - 40)
    red &= np.abs(picture - bare).max(axis=2) > 40
    body = stage.players[0].body
    shown = body.surface(15)
    shirt = view.project(shown.vertices[(shown.rgba[:, :3] - np.array([200, 20, 30]) / 255).max(axis=1) < 0.05])
    rows, columns = np.nonzero(red)
    assert len(rows) > 4, "stripes of the shirt"
    assert columns.mean() == pytest.approx(shirt[:, 0].mean(), abs=6)
    assert rows.mean() == pytest.approx(shirt[:, 1].mean(), abs=8)


@needs_graphics
def test_one_sees_through_what_is_not_opaque_and_into_what_is_open(folder):
    """A quad in front of another: half the front one's colour, half the other's; and both seen from behind."""
    square = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]])
    vertices = np.concatenate([square + np.array([0.0, 0.0, 0.5]), square])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    rgba = np.repeat([[0.0, 0.0, 1.0, 0.5], [1.0, 0.0, 0.0, 1.0]], 4, axis=0)
    carriers = np.zeros((8, 1), np.int64), np.ones((8, 1))
    clip = walk(2)
    rest = clip.joint_positions()[0].numpy()
    mesh = CharacterMesh(vertices, np.tile([0.0, 0, 1], (8, 1)), faces, rgba, *carriers, rest)
    body = Body(clip, mesh, Anatomy(clip), GREY)
    stage, brush = Stage([Shot(clip)]), select_painter("egl")

    def middle(azimuth: float) -> np.ndarray:
        content = replace(stage.content(0), figures=[Figure(body, 0)])
        view = stage.views(CameraSettings("fixed", azimuth_deg=azimuth, elevation_deg=10), (64, 64))[0]
        return brush.paint(view, content)[28:36, 28:36].reshape(-1, 3).mean(axis=0)

    front, back = middle(0.0), middle(180.0)
    assert front[0] > 60, "the red one is seen through the blue one"
    assert front[2] > 60
    assert back[0] > 100, "from behind too"
    assert back[2] < 90
