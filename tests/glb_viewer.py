"""A viewer of glTF files of its own, by the specification alone: where the joints and the skinned triangles are."""

import json
import struct
from os import PathLike
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

Array = np.ndarray
_TYPES = {5126: np.float32, 5121: np.uint8, 5123: np.uint16, 5125: np.uint32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GlbViewer:
    """A .glb, .vrm or .gltf file of one buffer."""

    def __init__(self, path: str | PathLike[str]):
        data = Path(path).read_bytes()
        if data[:4] == b"glTF":
            magic, version, length = struct.unpack("<4sII", data[:12])
            assert (magic, version, length) == (b"glTF", 2, len(data))
            size, kind = struct.unpack("<I4s", data[12:20])
            assert kind == b"JSON"
            self.tree = json.loads(data[20 : 20 + size])
            self.blob = data[20 + size + 8 :]
        else:
            self.tree = json.loads(data)
            self.blob = (Path(path).parent / self.tree["buffers"][0]["uri"]).read_bytes()
        self.nodes = self.tree["nodes"]
        self.parent = {child: k for k, node in enumerate(self.nodes) for child in node.get("children", ())}

    def array(self, index: int) -> Array:
        """An accessor's numbers, (count, width), normalised ones from 0 to 1."""
        accessor = self.tree["accessors"][index]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        width, dtype = _WIDTHS[accessor["type"]], _TYPES[accessor["componentType"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        table = np.frombuffer(self.blob, dtype, accessor["count"] * width, start).reshape(-1, width)
        return table / np.iinfo(dtype).max if accessor.get("normalized") else table.astype(np.float64)

    def node(self, name: str) -> int:
        """The node of a name."""
        (found,) = [k for k, node in enumerate(self.nodes) if node.get("name") == name]
        return found

    def animation(self, name: str) -> int:
        """The animation of a name."""
        (found,) = [k for k, one in enumerate(self.tree["animations"]) if one["name"] == name]
        return found

    def local(self, node: int, animation: int | None = None, seconds: float = 0.0) -> Array:
        """Matrix from a node's frame to its parent's, (4, 4), as the file stands or at a time of an animation."""
        given = self.nodes[node]
        tracks = {} if animation is None else self._tracks(animation, node, seconds)
        if "matrix" in given and not tracks:
            return np.array(given["matrix"]).reshape(4, 4).T
        position = tracks.get("translation", given.get("translation", (0, 0, 0)))
        turn = tracks.get("rotation", given.get("rotation", (0, 0, 0, 1)))
        scale = tracks.get("scale", given.get("scale", (1, 1, 1)))
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() * np.array(scale)
        matrix[:3, 3] = position
        return matrix

    def world(self, node: int, animation: int | None = None, seconds: float = 0.0) -> Array:
        """Matrix from a node's frame to the scene, (4, 4)."""
        own = self.local(node, animation, seconds)
        return self.world(self.parent[node], animation, seconds) @ own if node in self.parent else own

    def skinned(self, animation: int | None = None, seconds: float = 0.0) -> Array:
        """(n, 3) vertices of all skinned primitives, nodes in their order: linear blend skinning, morphs left out."""
        found = []
        for given in self.nodes:
            if "mesh" not in given or "skin" not in given:
                continue
            skin = self.tree["skins"][given["skin"]]
            inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
            worlds = [self.world(joint, animation, seconds) for joint in skin["joints"]]
            matrices = np.stack([world @ own for world, own in zip(worlds, inverse, strict=True)])
            for primitive in self.tree["meshes"][given["mesh"]]["primitives"]:
                at = primitive["attributes"]
                points = self.array(at["POSITION"])
                joints, weights = self.array(at["JOINTS_0"]).astype(int), self.array(at["WEIGHTS_0"])
                weights = weights / weights.sum(axis=1, keepdims=True)
                positions = np.column_stack([points, np.ones(len(points))])
                found.append(np.einsum("nk,nkij,nj->ni", weights, matrices[joints], positions)[:, :3])
        return np.concatenate(found)

    def _tracks(self, animation: int, node: int, seconds: float) -> dict[str, Array]:
        given, found = self.tree["animations"][animation], {}
        for channel in given["channels"]:
            if channel["target"].get("node") == node and channel["target"]["path"] != "weights":
                sampler = given["samplers"][channel["sampler"]]
                times, values = self.array(sampler["input"])[:, 0], self.array(sampler["output"])
                kind, path = sampler.get("interpolation", "LINEAR"), channel["target"]["path"]
                found[path] = _sample(times, values, seconds, kind, turns=path == "rotation")
        return found


def _sample(times: Array, values: Array, seconds: float, kind: str, *, turns: bool) -> Array:
    """Value of a track at a time, held before and after its keys."""
    at = float(np.clip(seconds, times[0], times[-1]))
    if kind == "CUBICSPLINE":
        values = values.reshape(len(times), 3, -1)
    low = int(np.clip(np.searchsorted(times, at, side="right") - 1, 0, max(len(times) - 2, 0)))
    if len(times) == 1:
        return values[0, 1] if kind == "CUBICSPLINE" else values[0]
    gap = times[low + 1] - times[low]
    share = (at - times[low]) / gap
    if kind == "STEP":
        return values[low + int(share >= 1)]
    if kind == "CUBICSPLINE":
        (_, a, leave), (arrive, b, _) = values[low], values[low + 1]
        t2, t3 = share**2, share**3
        found = (2 * t3 - 3 * t2 + 1) * a + gap * (t3 - 2 * t2 + share) * leave
        found = found + (3 * t2 - 2 * t3) * b + gap * (t3 - t2) * arrive
        return found / np.linalg.norm(found) if turns else found
    if turns:
        return Slerp([0, 1], Rotation.from_quat(values[low : low + 2]))(share).as_quat()
    return values[low] + share * (values[low + 1] - values[low])
