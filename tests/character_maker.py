"""Files of skinned characters as exporters write them: glTF and VRM, made here from nothing.

`make_character_glb(path)` writes a person like one that went from Mixamo through Blender: bones along their Y axes, in
centimetres and with Z up below an armature node that makes up for it, a picture on the shirt, several materials.
"""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from character_body import ENDS, PARENTS, PLACES, SIDES, Part, bone_frames, build_parts, pose_places, pose_turns
from scipy.spatial.transform import Rotation

Array = np.ndarray
_TYPES = {np.float32: 5126, np.uint8: 5121, np.uint16: 5123, np.uint32: 5125}
_WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_MIXAMO = {
    "hips": "Hips",
    "spine": "Spine",
    "spine1": "Spine1",
    "chest": "Spine2",
    "neck": "Neck",
    "head": "Head",
    "headEnd": "HeadTop_End",
    "Shoulder": "Shoulder",
    "UpperArm": "Arm",
    "LowerArm": "ForeArm",
    "Hand": "Hand",
    "Finger": "HandIndex1",
    "FingerEnd": "HandIndex2",
    "UpperLeg": "UpLeg",
    "LowerLeg": "Leg",
    "Foot": "Foot",
    "Toes": "ToeBase",
    "ToesEnd": "Toe_End",
}
_UNREAL = {
    "hips": "pelvis",
    "spine": "spine_01",
    "spine1": "spine_02",
    "chest": "spine_03",
    "neck": "neck_01",
    "head": "head",
    "headEnd": "head_end",
    "Shoulder": "clavicle",
    "UpperArm": "upperarm",
    "LowerArm": "lowerarm",
    "Hand": "hand",
    "Finger": "index_01",
    "FingerEnd": "index_02",
    "UpperLeg": "thigh",
    "LowerLeg": "calf",
    "Foot": "foot",
    "Toes": "ball",
    "ToesEnd": "ball_end",
}


def _split(joint: str) -> tuple[str, str]:
    side = next((side for side, _ in SIDES if joint.startswith(side)), "")
    return side, joint.removeprefix(side)


def name_joints(names: str | Mapping[str, str]) -> dict[str, str]:
    """A file's names by those of character_body: mixamo, readyplayer (no prefix), vrm, unreal, or any by a mapping."""
    if not isinstance(names, str):
        return {joint: names.get(joint, joint) for joint in PARENTS}
    found = {}
    for joint in PARENTS:
        side, part = _split(joint)
        if names in ("mixamo", "readyplayer"):
            found[joint] = ("mixamorig:" if names == "mixamo" else "") + side.capitalize() + _MIXAMO[part]
        elif names == "unreal":
            found[joint] = _UNREAL[part] + (f"_{side[0]}" if side else "")
        else:
            assert names in ("vrm", "vrm0"), f"no names {names!r}"
            found[joint] = f"J_Bip_{side[0].upper() if side else 'C'}_{part[0].upper() + part[1:]}"
    return found


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


LOOKS: Mapping[str, Look] = {
    "shirt": Look((1.0, 1.0, 1.0, 1.0), picture=True),
    "skin": Look((0.6, 0.35, 0.25, 1.0)),
    "trousers": Look((0.1, 0.15, 0.4, 1.0), vertex_colours=True),
    "shoes": Look((0.03, 0.03, 0.03, 1.0)),
    "hat": Look((0.1, 0.5, 0.2, 0.5), alpha="BLEND"),
}
"""Materials by part."""


@dataclass(frozen=True, eq=False)
class MadeCharacter:
    """A file that was written, and what is in it in truth."""

    path: Path
    tree: dict[str, Any]
    """The glTF document."""
    joint: Mapping[str, str]
    """The file's joint name by that of character_body (canonical names, and spine1, Finger, ...End)."""
    names: tuple[str, ...]
    """Of the joints, parents first."""
    nodes: tuple[int, ...]
    """Their nodes."""
    positions: Array
    """(joints, 3) in the world in the pose in which the skin is bound, metres."""
    rotations: Array
    """(joints, 3, 3) of their frames there, in the world."""
    vertices: Array
    """(n, 3) of the skinned triangles in that pose, in the world, in the file's order."""
    faces: Array
    """(m, 3) of them."""
    parts: tuple[Part, ...]
    """Of which body; their weights, pictures' places and triangles are the file's."""
    size: float
    """Factor on the body of character_body."""
    animations: tuple[str, ...] = field(default=())


def make_character_glb(
    path: str | PathLike[str],
    *,
    names: str | Mapping[str, str] = "mixamo",
    pose: str = "T",
    node_pose: str | None = None,
    size: float = 1.0,
    armature_scale: float = 0.01,
    zup_armature: bool = True,
    bones_along_y: bool = True,
    roll_deg: float = 17.0,
    root: str | None = None,
    leaves: str = "nodes",
    detail: int = 1,
    looks: Mapping[str, Look] = LOOKS,
    picture: Array | None = None,
    hat: bool = False,
    second_skin: bool = False,
    extra_nodes: bool = False,
    matrices: bool = False,
    morphs: int = 0,
    animations: Sequence[str] = (),
    frames: int = 31,
    interpolation: str = "LINEAR",
    compact: bool = False,
    bind: str = "world",
    armature: str = "Armature",
) -> MadeCharacter:
    """Write a person to .glb or .vrm, or .gltf with a .bin and a .png beside it.

    `pose` (T, A, bent) is that in which the skin is bound, `node_pose` that of the nodes, the same if not given. The
    node above the root scales by `armature_scale` and, if `zup_armature`, turns by -90 degrees about X; the joints'
    units and axes make up for it. `root` names a joint on the floor above the hips. `leaves` (nodes, joints, none)
    says whether the bones' ends are nodes alone or joints of the skin too. `second_skin` puts the trousers in a mesh
    and skin of their own, whose joints have another order. `hat` hangs on the head without a skin. `extra_nodes` adds
    a camera, a target and a moved mesh node, which skinning must not heed. `matrices` writes nodes as matrices.
    `animations` walk a metre ahead in `frames` frames at 30 a second, all with another swing. `compact` stores weights
    in 16 bits and joints in 8. `bind` says in which space vertices are: world, or armature. `picture` (height, width,
    3) uint8 replaces the stripes. A vrm0 faces -Z. Everything is the same on every call.
    """
    build = _Builder(Path(path))
    outer = np.eye(4)
    if zup_armature:
        outer[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    outer[:3, :3] *= armature_scale
    front = Rotation.from_euler("y", 180 if names == "vrm0" else 0, degrees=True)
    own = [*(["root"] if root else []), *(j for j in PARENTS if leaves != "none" or j not in ENDS)]
    parents = {j: PARENTS.get(j, "") or ("root" if root and j != "root" else "") for j in own}
    told = name_joints(names) | ({"root": root} if root else {})
    bound = _world_frames(pose, own, front, size, bones_along_y, roll_deg)
    posed = bound if node_pose is None else _world_frames(node_pose, own, front, size, bones_along_y, roll_deg)

    top = build.node(armature, None, outer, matrix=matrices)
    for joint in own:
        above = posed[parents[joint]] if parents[joint] else outer
        below = _unscaled(outer, above) if parents[joint] else above
        local = np.linalg.inv(below) @ posed[joint]
        local[:3, :3] = Rotation.from_matrix(_normal(local[:3, :3])).as_matrix()
        if parents[joint]:
            local[:3, 3] = above[:3, :3].T @ (posed[joint][:3, 3] - above[:3, 3]) / armature_scale
        build.node(told[joint], build.at.get(parents[joint], top), local, key=joint, matrix=matrices)

    skinned = [j for j in own if leaves == "joints" or j not in ENDS]
    space = outer if bind == "armature" else np.eye(4)
    turns, places = pose_turns(pose), pose_places(pose_turns(pose))
    parts = [_bend(part, turns, places, front, size) for part in build_parts(detail)]
    materials = {name: build.material(name, look, picture) for name, look in looks.items()}
    groups = [parts] if not second_skin else [[p for p in parts if p.name != "trousers"], [p for p in parts if p.name == "trousers"]]  # fmt: skip
    for number, group in enumerate(groups):
        joints = skinned if number == 0 else [j for j in skinned if j in group[0].weights][::-1]
        inverse = [np.linalg.inv(_scaled(bound[j], armature_scale)) @ space for j in joints]
        skin = build.skin(f"{armature}_skin{number or ''}", joints, np.stack(inverse))
        mesh = build.mesh(group, joints, np.linalg.inv(space), materials, looks, morphs=morphs, compact=compact)
        moved = np.eye(4)
        moved[:3, 3] = (1.0, 2.0, 3.0) if extra_nodes else 0.0
        build.tree["nodes"][build.node(f"Body{number or ''}", top, moved)] |= {"mesh": mesh, "skin": skin}
    if hat:
        _add_hat(build, materials["hat"], size, armature_scale)
    if extra_nodes:
        build.node("Camera", None, np.eye(4))
        build.node("IK_target", top, np.eye(4))
    for number, name in enumerate(animations):
        build.animation(name, own, frames, 20.0 + 8.0 * number, interpolation, 1.0 / armature_scale, morphs)
    if names in ("vrm", "vrm0"):
        _declare_humanoid(build, str(names))
    build.write()
    shift = np.cumsum([0, *(len(part.vertices) for group in groups for part in group)])
    order = [part for group in groups for part in group]
    return MadeCharacter(
        path=build.path,
        tree=build.tree,
        joint={j: told[j] for j in own if j != "root"},
        names=tuple(told[j] for j in own),
        nodes=tuple(build.at[j] for j in own),
        positions=np.stack([bound[j][:3, 3] for j in own]),
        rotations=np.stack([bound[j][:3, :3] for j in own]),
        vertices=np.concatenate([part.vertices for part in order]),
        faces=np.concatenate([part.faces + start for part, start in zip(order, shift, strict=False)]),
        parts=tuple(order),
        size=size,
        animations=tuple(animations),
    )


class _Builder:
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
        above = self.tree["scenes"][0]["nodes"] if parent is None else self.tree["nodes"][parent].setdefault("children", [])  # fmt: skip
        above.append(number)
        if key:
            self.at[key] = number
        return number

    def skin(self, name: str, joints: Sequence[str], inverse: Array) -> int:
        told = {"name": name, "joints": [self.at[j] for j in joints], "skeleton": self.at[joints[0]]}
        told["inverseBindMatrices"] = self.array(inverse.transpose(0, 2, 1).reshape(-1, 16))
        self.tree["skins"].append(told)
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
        made = []
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
            primitive["indices"] = self.array(part.faces.reshape(-1), np.uint32 if len(part.vertices) > 65535 else np.uint16)  # fmt: skip
            if morphs:
                bulges = [0.02 * (k + 1) * turned for k in range(morphs)]
                primitive["targets"] = [{"POSITION": self.array(bulge)} for bulge in bulges]
            made.append(primitive)
        told: dict[str, Any] = {"name": f"mesh{len(self.tree['meshes'])}", "primitives": made}
        if morphs:
            told |= {"weights": [0.0] * morphs, "extras": {"targetNames": [f"bulge{k}" for k in range(morphs)]}}
        self.tree["meshes"].append(told)
        return len(self.tree["meshes"]) - 1

    def animation(
        self, name: str, own: Sequence[str], frames: int, swing: float, kind: str, unit: float, morphs: int
    ) -> None:
        """A walk of a metre: arms and legs swing about their bodies' X axis, the root travels."""
        times = np.arange(frames) / 30
        clock, told = self.array(times), {"name": name, "channels": list[Any](), "samplers": list[Any]()}

        def add(node: int, path: str, values: Array) -> None:
            if kind == "CUBICSPLINE":
                slope = np.gradient(values, times, axis=0)
                values = np.stack([slope, values, slope], axis=1).reshape(-1, values.shape[1])
            output = self.array(values if path != "weights" else values.reshape(-1, 1))
            told["channels"].append({"sampler": len(told["samplers"]), "target": {"node": node, "path": path}})
            told["samplers"].append({"input": clock, "output": output, "interpolation": kind})

        top = self.at[own[0]]
        axes = self._outer_axes()
        ahead = np.outer(times / times[-1], axes.T @ np.array([0, 0, 1.0])) * unit
        add(top, "translation", np.array(_parts_of(self.tree["nodes"][top])[0]) + ahead)
        for joint in own:
            part = _split(joint)[1]
            sign = {"left": 1, "right": -1}.get(_split(joint)[0], 0) * (-1 if "Leg" in part else 1)
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
        self.tree.setdefault("animations", []).append(told)

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


def _world_frames(
    pose: str, own: Sequence[str], front: Rotation, size: float, along_y: bool, roll_deg: float
) -> dict[str, Array]:
    """World matrices of the joints' frames in a pose, without scale."""
    turns, frames = pose_turns(pose), bone_frames(along_y=along_y, roll_deg=roll_deg)
    places = pose_places(turns)
    found = {"root": np.eye(4)}
    found["root"][:3, :3] = front.as_matrix()
    for joint in own:
        if joint != "root":
            matrix = np.eye(4)
            matrix[:3, :3] = (front * turns[joint] * frames[joint]).as_matrix()
            matrix[:3, 3] = size * front.apply(places[joint])
            found[joint] = matrix
    return found


def _unscaled(outer: Array, above: Array) -> Array:
    return _scaled(above, float(np.cbrt(np.linalg.det(outer[:3, :3]))))


def _scaled(matrix: Array, scale: float) -> Array:
    found = matrix.copy()
    found[:3, :3] *= scale
    return found


def _normal(linear: Array) -> Array:
    return linear / np.cbrt(np.linalg.det(linear))


def _bend(part: Part, turns: Mapping[str, Rotation], places: Mapping[str, Array], front: Rotation, size: float) -> Part:
    """The part in the pose in which it is bound, by its own weights."""
    vertices, normals = np.zeros_like(part.vertices), np.zeros_like(part.normals)
    for joint, share in part.weights.items():
        vertices += share[:, None] * (turns[joint].apply(part.vertices - PLACES[joint]) + places[joint])
        normals += share[:, None] * turns[joint].apply(part.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Part(part.name, size * front.apply(vertices), front.apply(normals), part.faces, part.uv, part.weights)


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
    return matrix[:3, 3], Rotation.from_matrix(_normal(matrix[:3, :3])).as_quat()


def _add_hat(build: _Builder, material: int, size: float, armature_scale: float) -> None:
    """A box on the head: a mesh that no skin carries, in metres below a node that makes up for the armature's scale."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * size * 0.1
    faces = np.array([[0, 1, 3, 0, 3, 2, 4, 6, 7, 4, 7, 5, 0, 4, 5, 0, 5, 1, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 5, 7, 1, 7, 3]])  # fmt: skip
    primitive = {
        "attributes": {"POSITION": build.array(corners)},
        "indices": build.array(faces.reshape(-1), np.uint16),
        "material": material,
    }
    build.tree["meshes"].append({"name": "Hat", "primitives": [primitive]})
    local = np.eye(4)
    local[:3, :3] /= armature_scale
    local[:3, 3] = np.array([0.0, 0.2, 0.0]) * size / armature_scale
    node = build.node("Hat", build.at["head"], local)
    build.tree["nodes"][node]["mesh"] = len(build.tree["meshes"]) - 1


def _declare_humanoid(build: _Builder, names: str) -> None:
    """Say which node is which bone, as VRM 1.0 and 0.x do; the chest is their upper chest."""
    bones = {j: j for j in build.at if j not in ENDS and not j.endswith("Finger") and j != "root"}
    bones |= {"chest": "upperChest"} | ({"spine1": "chest"} if "spine1" in bones else {})
    if names == "vrm":
        humanoid: Any = {"humanBones": {bone: {"node": build.at[j]} for j, bone in bones.items()}}
        build.tree["extensions"] = {"VRMC_vrm": {"specVersion": "1.0", "humanoid": humanoid}}
    else:
        humanoid = {"humanBones": [{"bone": bone, "node": build.at[j]} for j, bone in bones.items()]}
        build.tree["extensions"] = {"VRM": {"humanoid": humanoid}}
    build.tree["extensionsUsed"] = list(build.tree["extensions"])
