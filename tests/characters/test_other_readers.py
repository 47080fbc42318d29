"""What other projects make of the characters that are written: Khronos' validator and trimesh."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from character_maker import make_character_glb
from helpers import walk
from test_gltf_characters import KINDS, follow_up, make

VALIDATOR = Path(__file__).parents[2] / ".venv" / "gltf-validator" / "node_modules" / "gltf-validator"
SCRIPT = """
const validator = require(process.argv[1]), fs = require('fs'), path = require('path');
const check = file => validator.validateBytes(new Uint8Array(fs.readFileSync(file)), {
  externalResourceFunction: uri => Promise.resolve(new Uint8Array(fs.readFileSync(path.join(path.dirname(file), uri)))),
}).then(report => report.issues);
Promise.all(process.argv.slice(2).map(check)).then(found => console.log(JSON.stringify(found)));
"""
needs_validator = pytest.mark.skipif(
    shutil.which("node") is None or not VALIDATOR.exists(),
    reason="needs node and Khronos' validator: .ci/setup validator",
)


def validate(*paths):
    """Codes of the errors and warnings of each file."""
    words = ["node", "-e", SCRIPT, str(VALIDATOR), *map(str, paths)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return [sorted(m["code"] for m in found["messages"] if m["severity"] < 2) for found in json.loads(done.stdout)]


@pytest.mark.slow
@needs_validator
def test_characters_are_as_valid_as_they_came(tmp_path):
    paths = []
    for kind in KINDS:
        (tmp_path / kind).mkdir()
        animations = () if "matrices" in KINDS[kind] else ("walk",)  # a node with a matrix cannot be animated
        made = make(tmp_path / kind, kind, animations=animations)
        out = made.path.with_stem("out")
        follow_up(made).save(out)
        paths += [made.path, out]
    found = validate(*paths)
    for kind, before, after in zip(KINDS, found[::2], found[1::2], strict=True):
        assert after == before, kind


@needs_validator
def test_embedded_files_and_the_mannequin_are_valid(tmp_path):
    made = make_character_glb(tmp_path / "hero.gltf")
    follow_up(made).save(tmp_path / "out.glb")
    walk(30).save(tmp_path / "mannequin.glb")
    for found in validate(tmp_path / "out.glb", tmp_path / "mannequin.glb"):
        assert set(found) <= {"NODE_SKINNED_MESH_NON_ROOT"}


def test_the_validator_sees_faults(tmp_path):
    if shutil.which("node") is None or not VALIDATOR.exists():
        pytest.skip("needs node and Khronos' validator")
    made = make(tmp_path, "mixamo")
    raw = made.path.read_bytes()
    made.path.write_bytes(raw.replace(b'"VEC4"', b'"VEC3"', 1))
    assert validate(made.path)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_trimesh_reads_them(kind, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    made = make(tmp_path, kind)
    out = tmp_path / "out.glb"
    motion = follow_up(made)
    motion.save(out)
    scene = trimesh.load_scene(out)
    before = trimesh.load_scene(made.path, file_type="glb")
    assert len(scene.geometry) == len(before.geometry) >= 1
    for name, mesh in before.geometry.items():
        np.testing.assert_array_equal(scene.geometry[name].vertices, mesh.vertices)
        np.testing.assert_array_equal(scene.geometry[name].faces, mesh.faces)
    for name in motion.skeleton.names:
        wanted, found = before.graph.get(name)[0], scene.graph.get(name)[0]
        np.testing.assert_allclose(found, wanted, atol=1e-9)
