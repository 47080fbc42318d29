"""A character's own mesh in files of other formats than the one that it came from."""

import numpy as np
import pytest
from character_maker import make_character_glb
from fbx_maker import make_fbx
from helpers import walk

from mapctl import formats, rotations
from mapctl.mesh.character_mesh import CharacterMesh
from mapctl.motion import Motion
from mapctl.retarget import figure
from mapctl.retarget.carry import RiggedCharacter, retarget_motion


def walk_on(path) -> Motion:
    """A walk on the character of a file."""
    body = RiggedCharacter.of(figure.load_standing_character(path))[1]
    return body.on_rig(retarget_motion(walk(8), body).motion)


def posed(mesh: CharacterMesh, motion: Motion, frame: int) -> np.ndarray:
    """Vertices in a frame of the motion."""
    turns = rotations.to_matrix(motion.joint_rotations()[frame]).numpy()
    return mesh.pose(motion.joint_positions()[frame].numpy(), turns)[0]


def pairs():
    """Formats in and out that differ."""
    return [(source, out) for source in (".glb", ".fbx", ".usda") for out in (".glb", ".usda") if source != out]


@pytest.mark.slow
@pytest.mark.parametrize(("source", "out"), pairs())
def test_the_mesh_goes_with_the_motion(source, out, tmp_path):
    for package, ending in (("pxr", ".usda"), ("ufbx", ".fbx")):
        if ending in (source, out):
            pytest.importorskip(package)
    file = tmp_path / f"hero{source}"
    if source == ".glb":
        make_character_glb(file, pose="A")
    elif source == ".fbx":
        make_fbx(file)
    else:
        from usd_maker import make_character_usd

        make_character_usd(file)
    motion = walk_on(file)
    motion.save(tmp_path / f"walk{out}")
    again, mesh, before = (
        formats.load(tmp_path / f"walk{out}"),
        formats.load_mesh(tmp_path / f"walk{out}"),
        formats.load_mesh(file),
    )
    assert len(mesh.vertices) == len(before.vertices)
    assert len(mesh.faces) == len(before.faces)
    for frame in (0, 7):
        np.testing.assert_allclose(posed(mesh, again, frame), posed(before, motion, frame), rtol=0, atol=2e-4)
    np.testing.assert_allclose(mesh.rgba[:, :3].mean(0), before.rgba[:, :3].mean(0), atol=0.02)


def test_a_motion_of_no_character_has_the_mannequin(tmp_path):
    walk(8).save(tmp_path / "walk.glb")
    assert len(formats.load_mesh(tmp_path / "walk.glb").vertices) > 1000


@pytest.mark.slow
def test_a_character_that_is_gone_leaves_the_mannequin(tmp_path):
    pytest.importorskip("ufbx")
    make_fbx(tmp_path / "hero.fbx")
    motion = walk_on(tmp_path / "hero.fbx")
    own = len(formats.load_mesh(tmp_path / "hero.fbx").vertices)
    (tmp_path / "hero.fbx").unlink()
    motion.save(tmp_path / "walk.glb")
    assert len(formats.load_mesh(tmp_path / "walk.glb").vertices) != own
