"""Files that Blender writes: FBX, USD and GLB have the joints of the BVH beside them."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from glb_viewer import GlbViewer
from helpers import walk

from mapctl import formats, rotations
from mapctl.retarget import figure
from mapctl.retarget.carry import RiggedCharacter, retarget_motion

BLENDER = Path(__file__).parents[2] / ".venv" / "blender" / "bin" / "python"
pytestmark = [
    pytest.mark.skipif(not BLENDER.exists(), reason="needs Blender as a module: .ci/setup blender"),
    pytest.mark.slow,
]


@pytest.fixture(scope="module", params=[0, 1, 2])
def folder(request, tmp_path_factory):
    made = tmp_path_factory.mktemp("blender")
    script = Path(__file__).with_name("blender_export.py")
    words = [str(BLENDER), str(script), str(made), str(request.param)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=280)
    assert (made / "clip.bvh").exists(), done.stderr[-500:]
    return made


def plain(names):
    """Names as USD has them: a point is no letter."""
    return [name.replace(".", "_") for name in names]


@pytest.mark.parametrize("name", ["skin.fbx", "limbs.fbx", "skin.usda", "skin.usdc", "skin.glb"])
def test_joints_are_those_of_the_bvh(folder, name):
    """To 0.1 mm; the BVH has Blender's Z up."""
    pytest.importorskip("ufbx" if name.endswith("fbx") else "pxr")
    told, motion = formats.load(folder / "clip.bvh", metres_per_unit=1.0), formats.load(folder / name)
    assert (motion.fps, motion.num_frames) == (told.fps, told.num_frames)
    assert sorted(plain(motion.skeleton.names)) == sorted(plain(told.skeleton.names))
    order = [plain(motion.skeleton.names).index(joint) for joint in plain(told.skeleton.names)]
    wanted = told.joint_positions().numpy()[..., [0, 2, 1]] * (1, 1, -1)
    size = 2.5 if name == "limbs.fbx" and "x" in scale_of(folder) else 1.0
    np.testing.assert_allclose(motion.joint_positions().numpy()[:, order], wanted * size, rtol=0, atol=1e-4 * size)


def scale_of(folder):
    """Which of the two ways of writing limbs.fbx was taken: `x` where it was written larger."""
    sizes = [formats.load(folder / name).skeleton.offsets.norm(dim=-1).sum() for name in ("limbs.fbx", "skin.fbx")]
    return "x" if float(sizes[0] / sizes[1]) > 2 else ""


def test_boxes_stay_on_their_bones(folder):
    """In every frame each box is as far from its joint as in the rest pose."""
    for name in ("skin.fbx", "skin.usda", "skin.glb"):
        motion, mesh = formats.load(folder / name), formats.load_mesh(folder / name)
        starts = np.linalg.norm(mesh.vertices - mesh.rest[mesh.joints[:, 0]], axis=1)
        assert starts.max() < 0.4
        for frame in (0, 11):
            places = motion.joint_positions()[frame].numpy()
            posed = mesh.pose(places, rotations.to_matrix(motion.joint_rotations()[frame]).numpy())[0]
            ends = np.linalg.norm(posed - places[mesh.joints[:, 0]], axis=1)
            np.testing.assert_allclose(ends, starts, atol=1e-5)


def test_glb_comes_back_animated(folder):
    """Another motion on the character of the GLB file; a viewer of glTF has its joints within 0.1 mm."""
    body = RiggedCharacter.of(figure.load_standing_character(folder / "skin.glb"))[1]
    motion = body.on_rig(retarget_motion(walk(15), body).motion)
    motion.save(folder / "out.glb")
    viewer = GlbViewer(folder / "out.glb")
    for frame in (0, 14):
        places = [viewer.world(int(node), 0, frame / 30)[:3, 3] for node in motion.source.nodes]
        np.testing.assert_allclose(motion.joint_positions()[frame], places, rtol=0, atol=1e-4)


def test_usd_comes_back_animated(folder):
    """Another motion on the character of the USD file; usd-core has its joints within 0.1 mm."""
    pytest.importorskip("pxr")
    from usd_viewer import UsdViewer, find_faults

    body = RiggedCharacter.of(figure.load_standing_character(folder / "skin.usdc"))[1]
    motion = body.on_rig(retarget_motion(walk(15), body).motion)
    motion.save(folder / "out.usda")
    viewer = UsdViewer(folder / "out.usda")
    for frame, code in enumerate(viewer.times(float(motion.fps))):
        np.testing.assert_allclose(motion.joint_positions()[frame], viewer.joints(code), rtol=0, atol=1e-4)
    assert find_faults(folder / "out.usda") == find_faults(folder / "skin.usdc")
