"""glTF documents that tests write, piece by piece."""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from character_body import SIDES, Part
from scipy.spatial.transform import Rotation

Array = np.ndarray
_TYPES = {np.float32: 5126, np.uint8: 5121, np.uint16: 5123, np.uint32: 5125}
_WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


@dataclass(frozen=True)
class Look:
    """A material, as glTF describes it."""

    colour: tuple[float, float, float, float] = (0.8, 0.8, 0.8, 1.0)
    """In proportion to light, and opacity."""
    picture: bool = False
    """Whether it shows the picture, red and white stripes along the tube."""
    alpha: str = "OPAQUE"
    vertex_colours: bool = False
    """Whether vertices have colours too: darker towards one end."""


class GlbBuilder:
    """A glTF document that grows, and its bytes."""

    def __init__(self, path: Path):
        self.path = path
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "mapctl tests"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{key: [] for key in ("nodes", "meshes", "skins", "materials", "accessors", "bufferViews")},
        }
        self.binary = bytearray()
        self.picture = b""
        self.at: dict[str, int] = {}

    def view(self, data: bytes) -> int:
        self.binary += bytes(-len(self.binary) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)})
        self.binary += data
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: Array, kind: type = np.float32, *, normalised: bool = False) -> int:
        """Add a table; VEC4 of bytes and the like are padded by nothing, since their rows are whole words."""
        table = np.ascontiguousarray(values, kind).reshape(len(values), -1)
        accessor = {
            "bufferView": self.view(table.tobytes()),
            "componentType": _TYPES[kind],
            "count": len(table),
            "type": _WIDTHS[table.shape[1]],
            "min": table.min(0).tolist(),
            "max": table.max(0).tolist(),
        }
        self.tree["accessors"].append(accessor | ({"normalized": True} if normalised else {}))
        return len(self.tree["accessors"]) - 1

    def node(self, name: str, parent: int | None, local: Array, *, key: str = "", matrix: bool = False) -> int:
        """Add a node at its place in its parent's frame; one scale for all axes."""
        scale = float(np.cbrt(np.linalg.det(local[:3, :3])))
        turn = Rotation.from_matrix(local[:3, :3] / scale).as_quat()
        parts: dict[str, Any] = {"matrix": local.T.reshape(-1).tolist()}
        if not matrix:
            parts = {"translation": local[:3, 3].tolist(), "rotation": turn.tolist(), "scale": [scale] * 3}
        number = len(self.tree["nodes"])
        self.tree["nodes"].append({"name": name, **parts})
        nodes, top = self.tree["nodes"], self.tree["scenes"][0]["nodes"]
        (top if parent is None else nodes[parent].setdefault("children", [])).append(number)
        if key:
            self.at[key] = number
        return number

    def skin(self, name: str, joints: Sequence[str], inverse: Array) -> int:
        given = {"name": name, "joints": [self.at[j] for j in joints], "skeleton": self.at[joints[0]]}
        given["inverseBindMatrices"] = self.array(inverse.transpose(0, 2, 1).reshape(-1, 16))
        self.tree["skins"].append(given)
        return len(self.tree["skins"]) - 1

    def material(self, name: str, look: Look, picture: Array | None) -> int:
        base: dict[str, Any] = {"baseColorFactor": list(look.colour)}
        if look.picture:
            if "textures" not in self.tree:
                self.picture = encode_png(stripes() if picture is None else picture)
                self.tree["images"] = [{"mimeType": "image/png", "bufferView": self.view(self.picture)}]
                self.tree["textures"] = [{"source": 0}]
            base["baseColorTexture"] = {"index": 0}
        self.tree["materials"].append({"name": name, "pbrMetallicRoughness": base, "alphaMode": look.alpha})
        return len(self.tree["materials"]) - 1

    def mesh(
        self,
        parts: Sequence[Part],
        joints: Sequence[str],
        space: Array,
        materials: Mapping[str, int],
        looks: Mapping[str, Look],
        *,
        morphs: int,
        compact: bool,
    ) -> int:
        result = []
        for part in parts:
            index, share = _pack_weights(part, joints)
            local = part.vertices @ space[:3, :3].T + space[:3, 3]
            turned = part.normals @ np.linalg.inv(space[:3, :3])
            attributes = {
                "POSITION": self.array(local),
                "NORMAL": self.array(turned / np.linalg.norm(turned, axis=1, keepdims=True)),
                "TEXCOORD_0": self.array(part.uv),
                "JOINTS_0": self.array(index, np.uint8 if compact else np.uint16),
            }
            weights = np.rint(share * 65535) if compact else share
            attributes["WEIGHTS_0"] = self.array(weights, np.uint16 if compact else np.float32, normalised=compact)
            if looks[part.name].vertex_colours:
                attributes["COLOR_0"] = self.array(np.repeat(0.4 + 0.6 * part.uv[:, 1:], 3, axis=1))
            primitive: dict[str, Any] = {"attributes": attributes, "material": materials[part.name]}
            wide = np.uint32 if len(part.vertices) > 65535 else np.uint16
            primitive["indices"] = self.array(part.faces.reshape(-1), wide)
            if morphs:
                bulges = [0.02 * (k + 1) * turned for k in range(morphs)]
                primitive["targets"] = [{"POSITION": self.array(bulge)} for bulge in bulges]
            result.append(primitive)
        given: dict[str, Any] = {"name": f"mesh{len(self.tree['meshes'])}", "primitives": result}
        if morphs:
            given |= {"weights": [0.0] * morphs, "extras": {"targetNames": [f"bulge{k}" for k in range(morphs)]}}
        self.tree["meshes"].append(given)
        return len(self.tree["meshes"]) - 1

    def animation(
        self, name: str, own: Sequence[str], frames: int, swing: float, kind: str, unit: float, morphs: int
    ) -> None:
        """A walk of a metre: arms and legs swing about their bodies' X axis, the root travels."""
        times = np.arange(frames) / 30
        clock, given = self.array(times), {"name": name, "channels": list[Any](), "samplers": list[Any]()}

        def add(node: int, path: str, values: Array) -> None:
            if kind == "CUBICSPLINE":
                slope = np.gradient(values, times, axis=0)
                values = np.stack([slope, values, slope], axis=1).reshape(-1, values.shape[1])
            output = self.array(values if path != "weights" else values.reshape(-1, 1))
            given["channels"].append({"sampler": len(given["samplers"]), "target": {"node": node, "path": path}})
            given["samplers"].append({"input": clock, "output": output, "interpolation": kind})

        top = self.at[own[0]]
        axes = self._outer_axes()
        ahead = np.outer(times / times[-1], axes.T @ np.array([0, 0, 1.0])) * unit
        add(top, "translation", np.array(_parts_of(self.tree["nodes"][top])[0]) + ahead)
        for joint in own:
            part = split_side(joint)[1]
            sign = {"left": 1, "right": -1}.get(split_side(joint)[0], 0) * (-1 if "Leg" in part else 1)
            most = {"UpperArm": swing, "UpperLeg": swing, "LowerLeg": swing / 2, "spine": 4.0}.get(part)
            if most is None:
                continue
            angle = np.radians(most) * (sign or 1) * np.sin(2 * np.pi * times) + (0.4 if part == "LowerLeg" else 0.0)
            rest = Rotation.from_quat(_parts_of(self.tree["nodes"][self.at[joint]])[1])
            axis = self._world_rotation(self.at[joint]).inv().apply([1.0, 0, 0])
            add(self.at[joint], "rotation", (rest * Rotation.from_rotvec(angle[:, None] * axis)).as_quat())
        body = next(k for k, node in enumerate(self.tree["nodes"]) if "mesh" in node)
        if morphs:
            add(body, "weights", np.tile(0.5 - 0.5 * np.cos(2 * np.pi * times)[:, None], (1, morphs)))
        self.tree.setdefault("animations", []).append(given)

    def _outer_axes(self) -> Array:
        return Rotation.from_quat(_parts_of(self.tree["nodes"][0])[1]).as_matrix()

    def _world_rotation(self, node: int) -> Rotation:
        parent = {child: k for k, one in enumerate(self.tree["nodes"]) for child in one.get("children", ())}
        turn = Rotation.from_quat(_parts_of(self.tree["nodes"][node])[1])
        return self._world_rotation(parent[node]) * turn if node in parent else turn

    def write(self) -> None:
        self.binary += bytes(-len(self.binary) % 4)
        self.tree["buffers"] = [{"byteLength": len(self.binary)}]
        self.tree = {key: value for key, value in self.tree.items() if value != []}
        if self.path.suffix.lower() == ".gltf":
            beside = self.path.with_suffix(".bin")
            beside.write_bytes(self.binary)
            self.tree["buffers"][0]["uri"] = beside.name
            if self.picture:
                self.path.with_suffix(".png").write_bytes(self.picture)
                self.tree["images"] = [{"uri": self.path.with_suffix(".png").name}]
            self.path.write_text(json.dumps(self.tree))
            return
        self.path.write_bytes(pack_glb(self.tree, bytes(self.binary)))


def pack_glb(tree: Mapping[str, Any], binary: bytes) -> bytes:
    """A .glb file of a document and its binary chunk."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def stripes() -> Array:
    """A picture of 8 red and white stripes across, 64 x 16 pixels."""
    picture = np.full((64, 16, 3), 255, np.uint8)
    picture[np.arange(64) // 8 % 2 == 0] = (200, 20, 30)
    return picture


def encode_png(picture: Array) -> bytes:
    """A PNG of (height, width, 3) uint8."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = picture.shape[:2]
    rows = np.insert(np.ascontiguousarray(picture).reshape(height, -1), 0, 0, axis=1).astype(np.uint8)
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows.tobytes())) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def split_side(joint: str) -> tuple[str, str]:
    side = next((side for side, _ in SIDES if joint.startswith(side)), "")
    return side, joint.removeprefix(side)


def _pack_weights(part: Part, joints: Sequence[str]) -> tuple[Array, Array]:
    """The four strongest joints of each vertex, as indices in the skin, and their shares."""
    table = np.stack([part.weights.get(j, np.zeros(len(part.vertices))) for j in joints], axis=1)
    table = np.pad(table, ((0, 0), (0, max(0, 4 - table.shape[1]))))
    index = np.argsort(-table, axis=1, kind="stable")[:, :4]
    share = np.take_along_axis(table, index, axis=1)
    return np.where(share > 0, index, 0), share / share.sum(axis=1, keepdims=True)


def _parts_of(node: Mapping[str, Any]) -> tuple[Array, Array]:
    """Translation and rotation of a node, however it is written."""
    if "matrix" not in node:
        return np.array(node["translation"]), np.array(node["rotation"])
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    return matrix[:3, 3], Rotation.from_matrix(without_scale(matrix[:3, :3])).as_quat()


def without_scale(linear: Array) -> Array:
    return linear / np.cbrt(np.linalg.det(linear))
