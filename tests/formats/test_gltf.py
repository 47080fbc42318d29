"""GLB out: what a viewer computes from the file is where the body is."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from helpers import random_motion

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats.gltf import mannequin
from mapctl.mesh.skinning import at_rest, build_skin
from mapctl.skeleton import CANONICAL

_TYPES = {5126: np.float32, 5123: np.uint16, 5125: np.uint32}
_WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Viewer:
    """A glTF reader of a few lines, by the specification: JSON chunk, binary chunk, skinning."""

    def __init__(self, data: bytes):
        magic, version, length = struct.unpack("<4sII", data[:12])
        assert (magic, version, length) == (b"glTF", 2, len(data))
        size, kind = struct.unpack("<I4s", data[12:20])
        assert kind == b"JSON"
        self.tree = json.loads(data[20 : 20 + size])
        self.blob = data[20 + size + 8 :]

    def array(self, index):
        accessor = self.tree["accessors"][index]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        count = accessor["count"] * _WIDTH[accessor["type"]]
        raw = np.frombuffer(self.blob, _TYPES[accessor["componentType"]], count, view.get("byteOffset", 0))
        table = raw.reshape(accessor["count"], -1)
        np.testing.assert_allclose(table.min(0), accessor["min"], atol=1e-6)
        np.testing.assert_allclose(table.max(0), accessor["max"], atol=1e-6)
        return table.astype(np.float64)

    def worlds(self, frame):
        """4x4 matrices of the nodes in a frame."""
        nodes = self.tree["nodes"]
        place = {k: np.array(n.get("translation") or (0, 0, 0), float) for k, n in enumerate(nodes)}
        turn = dict.fromkeys(place, np.array([0, 0, 0, 1.0]))
        animation = self.tree["animations"][0]
        for channel in animation["channels"]:
            values = self.array(animation["samplers"][channel["sampler"]]["output"])[frame]
            (place if channel["target"]["path"] == "translation" else turn)[channel["target"]["node"]] = values
        found = {}

        def visit(node, above):
            local = np.eye(4)
            x, y, z, w = turn[node]
            local[:3, :3] = np.eye(3) + 2 * np.array(
                [
                    [-y * y - z * z, x * y - z * w, x * z + y * w],
                    [x * y + z * w, -x * x - z * z, y * z - x * w],
                    [x * z - y * w, y * z + x * w, -x * x - y * y],
                ]
            )
            local[:3, 3] = place[node]
            found[node] = above @ local
            for child in nodes[node].get("children") or ():
                visit(child, found[node])

        for top in self.tree["scenes"][0]["nodes"]:
            visit(top, np.eye(4))
        return found

    def skinned(self, frame):
        """(n, 3) vertices of the mesh in a frame."""
        attributes = self.tree["meshes"][0]["primitives"][0]["attributes"]
        worlds, told = self.worlds(frame), self.tree["skins"][0]
        inverse = self.array(told["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        matrices = np.stack([worlds[j] @ inverse[k] for k, j in enumerate(told["joints"])])
        places = np.column_stack([self.array(attributes["POSITION"]), np.ones(len(self.array(attributes["POSITION"])))])
        joints, weights = self.array(attributes["JOINTS_0"]).astype(int), self.array(attributes["WEIGHTS_0"])
        assert np.allclose(weights.sum(1), 1)
        return np.einsum("nk,nkij,nj->ni", weights, matrices[joints], places)[:, :3]


@pytest.fixture(scope="module")
def motion():
    return random_motion(CANONICAL, 12, seed=4)


def test_joints_and_skin_are_where_the_motion_says(motion):
    viewer = Viewer(mannequin.to_bytes(motion))
    body, turns = build_skin(motion), motion.joint_rotations()
    matrices, places = rotations.to_matrix(turns).numpy(), motion.joint_positions().numpy()
    for frame in (0, 7, 11):
        worlds = viewer.worlds(frame)
        for joint, name in enumerate(CANONICAL.names):
            assert viewer.tree["nodes"][joint]["name"] == name
            np.testing.assert_allclose(worlds[joint][:3, 3], places[frame, joint], atol=2e-6)
        expected = np.einsum("nij,nj->ni", matrices[frame, body.joint], body.vertices) + places[frame, body.joint]
        np.testing.assert_allclose(viewer.skinned(frame), expected, atol=5e-6)


def test_quaternions_are_unit_and_do_not_jump_in_sign(motion):
    viewer = Viewer(mannequin.to_bytes(motion))
    animation = viewer.tree["animations"][0]
    times = viewer.array(animation["samplers"][0]["input"])[:, 0]
    np.testing.assert_allclose(times, np.arange(12) / float(motion.fps), atol=1e-6)
    for channel in animation["channels"]:
        if channel["target"]["path"] == "rotation":
            quats = viewer.array(animation["samplers"][channel["sampler"]]["output"])
            assert np.allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
            assert (np.sum(quats[1:] * quats[:-1], axis=1) >= 0).all()


def test_same_motion_same_bytes(motion, tmp_path):
    motion.save(tmp_path / "a.glb")
    assert (tmp_path / "a.glb").read_bytes() == mannequin.to_bytes(motion)


def test_nan_is_refused(motion, tmp_path):
    broken = replace(motion, root_position=motion.root_position * float("nan"))
    with pytest.raises(RequestError, match="no finite position"):
        broken.save(tmp_path / "x.glb")
    assert not list(tmp_path.iterdir())


def test_skin_at_rest_stands_on_the_ground_as_large_as_a_person():
    rest = at_rest()
    body, places = build_skin(rest), rest.joint_positions()[0].numpy()
    world = body.vertices + places[body.joint]  # nothing is turned at rest
    assert -0.02 < world[:, 1].min() < 0.03
    assert 1.3 < world[:, 1].max() < 2.0
    assert np.allclose(np.linalg.norm(body.normals, axis=1), 1)
    assert set(body.joint) <= set(range(CANONICAL.num_joints))
    assert (body.joint[body.faces] == body.joint[body.faces[:, :1]]).all(), "a triangle hangs on one joint"
