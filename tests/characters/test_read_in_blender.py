"""Characters that mapctl writes, opened in Blender: joints, soles, materials and morphs."""

import numpy as np
import pytest
from blender_session import needs_blender, run_in_blender
from helpers import walk
from test_gltf_characters import follow_up, make

from mapctl import rotations
from mapctl.formats import load_mesh

FRAMES = 12


@needs_blender
@pytest.mark.parametrize("kind", ["a-pose", pytest.param("vrm", marks=pytest.mark.slow)])
def test_blender_shows_what_was_written(kind, tmp_path):
    made = make(tmp_path, kind, animations=("walk",), morphs=2)
    out = tmp_path / "new.glb"
    motion = follow_up(made, FRAMES)
    motion.save(out)
    facts, arrays = run_in_blender("read_character.py", tmp_path, out, 30, FRAMES, "new")
    assert {name.split("_")[0] for name in facts["actions"]} >= {"new", "walk"}
    assert set(facts["materials"]) >= {"shirt", "skin", "trousers", "shoes"}
    assert len([name for name in facts["morphs"] if name != "Basis"]) >= 2
    shared = [name for name in facts["joints"] if name in motion.skeleton.names]
    assert len(shared) >= 21
    where = [facts["joints"].index(name) for name in shared]
    places = arrays["places"][:, where][..., [0, 2, 1]] * (1, 1, -1)  # Blender has Z up
    wanted = motion.joint_positions()[:, [motion.skeleton.index(name) for name in shared]].numpy()
    np.testing.assert_allclose(places, wanted, rtol=0, atol=1e-4)
    mesh = load_mesh(made.path)
    for frame in (0, FRAMES - 1):
        turns = rotations.to_matrix(motion.joint_rotations()[frame]).numpy()
        vertices, _ = mesh.pose(motion.joint_positions()[frame].numpy(), turns)
        np.testing.assert_allclose(arrays["lowest"][frame], vertices[:, 1].min(), atol=1e-3)


def test_the_walk_moves():
    """Else the test above would pass for a character that stands."""
    assert float(walk(FRAMES).joint_positions().diff(dim=0).abs().max()) > 0.01
