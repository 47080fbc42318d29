"""glTF 2.0, VRM and VRM animations: characters in, and motions out, on their own character or on a mannequin.

A file is a JSON document with buffers: .glb and .vrm in one file, .gltf with files beside it. The document is read and
written as plain dictionaries: pygltflib takes seconds to read one of a thousand accessors. Written are metres, Y up;
every joint has a rotation track at the motion's own frames, one that travels a translation.

VRM animations follow VRMC_vrm_animation 1.0: the bones of a humanoid alone, at rest a T-pose that faces +Z; only the
hips travel, no node is scaled, and eyes are none of the bones.
"""

import base64
import copy
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from os import PathLike
from pathlib import Path, PurePath
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.formats import parts
from mapctl.formats.atomic import write_bytes
from mapctl.formats.bvh import all_translations
from mapctl.formats.character import CharacterSource, build_skinned_body, character_of
from mapctl.formats.sandbox import Refusal
from mapctl.formats.text import MAX_FILE_BYTES, check_ordinary, one_line, read_bytes, shorten, warn_once
from mapctl.formats.units import sample_times
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.version import __version__

Array = np.ndarray
Json = dict[str, Any]
LICENCE = "licence"
"""Key of the asset's extras under which mapctl writes the licence of a motion."""
ANIMATION = "VRMC_vrm_animation"
"""Extension of a file that holds the animation of a humanoid alone."""
_EXTENSIONS = "VRMC_vrm", ANIMATION
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_DRACO, _MESHOPT = {"KHR_draco_mesh_compression"}, {"EXT_meshopt_compression", "KHR_meshopt_compression"}
_DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_VALUES = 2**28
_MALFORMED = (AttributeError, LookupError, TypeError, ValueError, OverflowError, RecursionError)
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_AT_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
_STILL = 1e-6  # metres and quaternion components that vary less than this need one key
_STILL_METRES = 1e-3
_MIME = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX": "image/ktx2"}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENT = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_THUMBS = {"ThumbProximal": "ThumbMetacarpal", "ThumbIntermediate": "ThumbProximal"}
"""Bones of VRM 0 that have another name in VRM 1."""
_HALF_TURN = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)


@contextmanager
def _refuse_malformed() -> Iterator[None]:
    """Raise Refusal where a document has other entries than glTF's."""
    try:
        yield
    except _MALFORMED as error:
        raise Refusal(f"is no sound glTF file: {type(error).__name__}: {one_line(error)}") from error


@_refuse_malformed()
def read_character(path: Path, *, armature: str | None, animation: str | None, wanted: str) -> parts.FoundCharacter:
    """Read an armature, and `wanted` besides: `rest` nothing, `motion` its animation, `mesh` its triangles. Refusal
    gives the reason.

    The rest pose is the one in which the skins are bound where all of them hold one and bones are as long as the
    nodes' (VRM files: always the nodes'); else the nodes'.
    """
    gltf = read_file(path)
    listed, own = parts.choose_armature(path, find_armatures(gltf), armature)
    nodes = [gltf.get("nodes", node) for node in own.nodes]
    outer = gltf.chain(gltf.nodes.line(own.nodes[0])[1:])
    worlds = parts.chain_matrices(own.parents, np.stack([_node_matrix(node) for node in nodes]), outer)
    is_vrm = any(name in gltf.tree.get("extensions", {}) for name in ("VRM", *_EXTENSIONS))  # whatever its ending
    bound = None if is_vrm else _bind_worlds(gltf, own, worlds, outer)
    names = parts.make_unique([str(n.get("name") or f"node_{k}") for n, k in zip(nodes, own.nodes, strict=True)])
    found = parts.FoundCharacter(
        armature=own.name,
        armatures=listed,
        names=names,
        nodes=own.nodes,
        parents=own.parents,
        metres_per_unit=1.0,
        worlds=worlds if bound is None else bound,
        outer=outer,
        ends={joint: _node_matrix(gltf.get("nodes", node)) for joint, node in own.ends.items()},
        humanoid=_name_bones(gltf, dict(zip(own.nodes, names, strict=True))),
    )
    if wanted == "motion":
        _read_motion(gltf, own, animation, found)
    if wanted == "mesh":
        found.parts = list(_read_parts(gltf, own))
    return found


def _name_bones(gltf: "Gltf", names: Mapping[int, str]) -> dict[str, str]:
    """Return the joint by canonical name, of those whose `names` are given by node."""
    bones = {bone: names[node] for bone, node in read_bones(gltf).items() if node in names}
    if "upperChest" in bones:  # it carries the arms, and is the canonical chest where a file has one
        bones["chest"] = bones["upperChest"]
    return {bone: name for bone, name in bones.items() if bone in CANONICAL.names}


def _read_motion(gltf: "Gltf", armature: parts.Armature, wanted: str | None, found: parts.FoundCharacter) -> None:
    """Add the wanted animation, else the first that moves the armature, to what was found."""
    names = _name_animations(gltf)
    numbers = range(len(names)) if wanted is None else [parts.find_name("", names, wanted, "animation")]
    read = ((names[number], _read_tracks(gltf, number, armature.nodes)) for number in numbers)
    name, tracks = next((own for own in read if own[1]), (None, []))
    if name is None:
        if wanted is not None:
            raise Refusal(f"animation {wanted!r} does not move {armature.name!r}")
        return
    found.animation, found.animations = name, _time_animations(gltf, armature.nodes)
    fps, local = _sample_tracks(gltf, armature.nodes, tracks)
    found.motion = fps, parts.chain_matrices(armature.parents, local, found.outer)
    extras = gltf.tree["asset"].get("extras")
    licence = extras.get(LICENCE) if isinstance(extras, dict) else None
    found.licence = licence if isinstance(licence, str) else ""


@dataclass(frozen=True, eq=False)
class Gltf:
    """A glTF document with its buffers. What is not there, or no tree, is a Refusal."""

    path: Path
    tree: Json
    buffers: list[bytes]

    def all(self, kind: str) -> list[Json]:
        """Return all of the document's `nodes`, `skins`, `accessors`, ..."""
        return self.tree.get(kind, [])

    def get(self, kind: str, index: int) -> Json:
        found = self.all(kind)
        if not 0 <= index < len(found):
            raise Refusal(f"has no {kind}[{index}], but {len(found)}")
        return found[index]

    @cached_property
    def nodes(self) -> parts.NodeTree:
        """The tree of the nodes."""
        return parts.NodeTree({k: node.get("children", ()) for k, node in enumerate(self.all("nodes"))})

    def chain(self, line: Sequence[int]) -> Array:
        """Return what takes the first node's frame to the frame that the last is in, (4, 4)."""
        matrix = np.eye(4)
        for node in reversed(line):
            matrix = matrix @ _node_matrix(self.get("nodes", node))
        return matrix


def read_file(path: str | PathLike[str]) -> Gltf:
    """Read a glTF file. Refusal or FileFormatError names its fault: also compression that is not read here,
    and other files that are not there or lie outside its folder."""
    file = Path(path)
    raw = read_bytes(file)
    if raw[:4] == b"glTF":
        text, binary = _split_chunks(raw)
    elif file.suffix.lower() == ".gltf":
        text, binary = raw, b""
    else:
        raise Refusal(f"is no binary glTF: it begins with {raw[:4]!r}, not b'glTF'")
    tree = _parse_json(text)
    version = str(tree["asset"]["version"])
    if not version.startswith("2."):
        raise Refusal(f"is glTF {shorten(version)}, expected 2.0")
    for name in (_DRACO | _MESHOPT) & set(tree.get("extensionsRequired", ())):
        raise Refusal(f"is compressed ({name}); export it again without compression")
    buffers: list[bytes] = []
    for number, buffer in enumerate(tree.get("buffers", [])):
        size, uri = buffer["byteLength"], buffer.get("uri")
        data = _read_neighbour(file, uri) if uri is not None else binary if number == 0 else b""
        if not 0 <= size <= min(len(data), MAX_FILE_BYTES):
            raise Refusal(f"buffers[{number}] should have {size} bytes, there are {len(data)}")
        buffers.append(data)
    return Gltf(file, tree, buffers)


def _split_chunks(whole: bytes) -> tuple[bytes, bytes]:
    """Split a .glb file into its document and its binary chunk, empty where there is none."""
    if len(whole) < _HEADER.size + _CHUNK.size:
        raise Refusal(f"is cut off after {len(whole)} bytes")
    _, version, length = _HEADER.unpack_from(whole)
    if version != 2:
        raise Refusal(f"is glTF {version}, expected 2.0")
    if length > len(whole):
        raise Refusal(f"is cut off: it declares {length} bytes and has {len(whole)}")
    chunks: list[tuple[bytes, bytes]] = []
    at = _HEADER.size
    while at + _CHUNK.size <= length and len(chunks) < 2:
        size, kind = _CHUNK.unpack_from(whole, at)
        at += _CHUNK.size
        if at + size > length:
            raise Refusal(f"is cut off: a chunk of {size} bytes goes beyond its end")
        chunks.append((kind, whole[at : at + size]))
        at += size
    if not chunks or chunks[0][0] != b"JSON":
        raise Refusal("has no JSON chunk where one is expected, after its header")
    return chunks[0][1], chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else b""


def _parse_json(text: bytes) -> Json:
    def refuse(word: str) -> float:
        raise ValueError(f"{word} is no number of JSON")

    try:
        plain = text.decode("utf-8-sig")
        tree = json.loads(plain, parse_constant=refuse)
        if "\\ud" in plain.lower():  # half of a surrogate pair is no text, and cannot be written again
            json.dumps(tree, ensure_ascii=False).encode()
    except RecursionError:
        raise Refusal("its JSON is nested too deeply") from None
    except ValueError as error:  # also UnicodeDecodeError and JSONDecodeError
        raise Refusal(f"its JSON cannot be read: {error}") from None
    if not isinstance(tree, dict):
        raise Refusal("its JSON is no object")
    return tree


def _read_neighbour(path: Path, uri: str) -> bytes:
    """Read what a document names by `uri`: data within it, or a file in its folder or below. Refusal where it is not
    there, lies elsewhere, or is none of both."""
    if uri.startswith("data:"):
        head, _, data = uri.partition(",")
        try:
            if head.endswith(";base64"):
                return base64.b64decode(data, validate=True)
        except ValueError:
            pass
        raise Refusal(f"{shorten(uri)}: is no base64, as data in a document are")
    named = Path(unquote(uri).replace("\0", "?"))
    folder = path.parent.resolve()
    target = (folder / named).resolve()
    if "://" in uri or named.is_absolute() or not target.is_relative_to(folder):
        raise Refusal(f"names {shorten(uri)}, which is not in its folder; such files are not read")
    if not target.is_file():
        raise Refusal(f"names {shorten(uri)}, which is not there")
    check_ordinary(target)
    return target.read_bytes()


def _read_view(gltf: Gltf, index: int) -> memoryview:
    view = gltf.get("bufferViews", index)
    if _MESHOPT & view.get("extensions", {}).keys():
        raise Refusal(f"bufferViews[{index}] is compressed (meshopt); export it without compression")
    gltf.get("buffers", view["buffer"])
    data, start = gltf.buffers[view["buffer"]], view.get("byteOffset", 0)
    stop = start + view["byteLength"]
    if not 0 <= start <= stop <= len(data):
        raise Refusal(f"bufferViews[{index}] goes beyond its buffer of {len(data)} bytes")
    return memoryview(data)[start:stop]


def read_accessor(gltf: Gltf, index: int, *kinds: str) -> Array:
    """Return an accessor's numbers, (count, width): float64, scaled where they are normalised, or whole as they are.

    `kinds` are the types allowed here, such as `VEC3`. Refusal where it is not there, is of another type, lies beyond
    its buffer, or holds what is not finite.
    """
    accessor, what = gltf.get("accessors", index), f"accessors[{index}]"
    count, kind, component = accessor["count"], accessor["type"], accessor["componentType"]
    if kind not in kinds:
        raise Refusal(f"{what} is {kind}, expected {' or '.join(kinds)}")
    if component not in _DTYPES or not 0 < count * _WIDTHS[kind] <= _MAX_VALUES:
        raise Refusal(f"{what} has {count} elements of componentType {component}")
    dtype, shape = np.dtype(_DTYPES[component]).newbyteorder("<"), (count, _WIDTHS[kind])
    values = np.zeros(shape, dtype)
    if accessor.get("bufferView") is not None:
        values = _read_table(gltf, accessor, shape, dtype, what)
    if (sparse := accessor.get("sparse")) is not None:
        many, what = sparse["count"], f"{what}.sparse"
        if not 0 < many <= count:
            raise Refusal(f"{what} replaces {many} of {count} elements")
        index_type = np.dtype(_DTYPES[sparse["indices"]["componentType"]]).newbyteorder("<")
        at = _read_table(gltf, sparse["indices"], (many, 1), index_type, what)[:, 0].astype(np.int64)
        values = values.copy()
        values[at] = _read_table(gltf, sparse["values"], (many, shape[1]), dtype, what)
    if dtype.kind == "f":
        if not np.isfinite(values).all():
            raise Refusal(f"{what} holds numbers that are not finite")
        return values.astype(np.float64)
    if accessor.get("normalized", False):
        return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0)
    return values.astype(np.int64)


def _read_table(gltf: Gltf, entry: Json, shape: tuple[int, int], dtype: np.dtype, what: str) -> Array:
    """Read a table from the view that an entry names; rows may lie further apart than they are long."""
    index, offset = entry["bufferView"], entry.get("byteOffset", 0)
    data, row = _read_view(gltf, index), shape[1] * dtype.itemsize
    stride = gltf.get("bufferViews", index).get("byteStride") or row
    needed = offset + (shape[0] - 1) * stride + row
    if offset < 0 or needed > len(data) or stride < row:
        raise Refusal(f"{what} needs {needed} bytes of bufferViews[{index}], which has {len(data)}")
    return np.ndarray(shape, dtype, data, offset, (stride, dtype.itemsize))


def _bind_worlds(gltf: Gltf, armature: parts.Armature, worlds: Array, outer: Array) -> Array | None:
    """Return world matrices (joints, 4, 4) of the pose in which the skins are bound, as far as they agree with the
    nodes' bones; None where they do not, or are not said.

    Bind matrices are in the space of the vertices: that of the scene, or that of what is above the root.
    """
    index_of = {node: index for index, node in enumerate(armature.nodes)}
    bound: dict[int, Array] = {}
    for number in armature.skins:
        inverse = _read_inverse_binds(gltf, number)
        if inverse is None:
            return None
        for node, matrix in zip(gltf.get("skins", number)["joints"], inverse, strict=True):
            bound.setdefault(index_of[node], np.linalg.inv(matrix))  # a ValueError where it is singular
    spaces = ({joint: space @ matrix for joint, matrix in bound.items()} for space in (np.eye(4), outer))
    return parts.complete_bind_pose(armature.parents, spaces, worlds)


def _read_inverse_binds(gltf: Gltf, skin: int) -> Array | None:
    """Return the matrices (joints, 4, 4) from a skin's vertices to its joints' frames; None where it has none."""
    entry = gltf.get("skins", skin)
    if entry.get("inverseBindMatrices") is None:
        return None
    inverse = read_accessor(gltf, entry["inverseBindMatrices"], "MAT4").reshape(-1, 4, 4).transpose(0, 2, 1)
    count = len(entry["joints"])
    if len(inverse) < count:
        raise Refusal(f"skins[{skin}] has {count} joints and {len(inverse)} inverse bind matrices")
    return inverse[:count]


def _node_parts(node: Json) -> dict[str, Array]:
    """Return translation (3,), rotation xyzw (4,) and scale (3,) of a node without a matrix."""
    placed = {key: np.array(node.get(key, usual), np.float64) for key, usual in _AT_REST.items()}
    if any(part.shape != (len(_AT_REST[key]),) for key, part in placed.items()):
        raise ValueError("a node's translation and scale have 3 numbers, its rotation 4")
    return placed


def _node_matrix(node: Json) -> Array:
    """Return what takes a node's frame to its parent's, (4, 4)."""
    if node.get("matrix") is not None:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    return parts.compose_matrices(*_node_parts(node).values())


def read_bones(gltf: Gltf) -> dict[str, int]:
    """Return the node of each bone of the humanoid, by VRM's name; empty for files that are no VRM."""
    extensions = gltf.tree.get("extensions", {})
    for name in _EXTENSIONS:
        if name in extensions:
            bones = extensions[name].get("humanoid", {}).get("humanBones", {})
            return {bone: found["node"] for bone, found in bones.items()}
    bones = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    return {bone["bone"]: bone["node"] for bone in bones}


def find_armatures(gltf: Gltf) -> list[parts.Armature]:
    """Find the armatures of a file; Refusal where nothing marks nodes as joints, or they are no tree."""
    skins, groups = gltf.all("skins"), list[tuple[set[int], list[int]]]()
    targets = [c["target"] for animation in gltf.all("animations") for c in animation.get("channels", ())]
    animated = {t["node"] for t in targets if t.get("node") is not None and t["path"] != "weights"}
    if not skins:
        groups = [(joints, []) for joints in _find_bare_joints(gltf, animated)]
    for number, skin in enumerate(skins):
        for node in skin["joints"]:
            gltf.get("nodes", node)
        joints = set(gltf.nodes.connect(skin["joints"]))
        near = [group for group in groups if group[0] & joints or _share_line(gltf, group[0], joints)]
        groups = [group for group in groups if group not in near]
        groups.append((joints.union(*(g[0] for g in near)), sorted({number, *(s for g in near for s in g[1])})))
    by_skin = sorted(groups, key=lambda group: group[1])
    return [_build_armature(gltf, joints, own, animated) for joints, own in by_skin]


def _share_line(gltf: Gltf, first: set[int], second: set[int]) -> bool:
    """Return whether one set of joints hangs below the other: a hat's skin below the head's joint."""
    tops = [min(nodes, key=lambda node: len(gltf.nodes.line(node))) for nodes in (first, second)]
    return bool(set(gltf.nodes.line(tops[0])) & second or set(gltf.nodes.line(tops[1])) & first)


def _find_bare_joints(gltf: Gltf, animated: set[int]) -> list[set[int]]:
    """Find the joints of the characters of a file without a skin: the humanoid's, else of each tree those that an
    animation moves, and those below them that carry others."""
    bones = set(read_bones(gltf).values())
    for node in bones or animated:
        gltf.get("nodes", node)
    if bones:
        return [bones]
    if not animated:
        raise Refusal("has no skin, no humanoid and no animation, so nothing in it marks nodes as a character's joints")
    tops: dict[int, list[int]] = {}
    for node in sorted(animated):
        tops.setdefault(gltf.nodes.line(node)[-1], []).append(node)
    bodies = [moved for moved in tops.values() if len(moved) > 1] or list(tops.values())
    walks = [(set(moved), gltf.nodes.walk(gltf.nodes.connect(moved)[0])) for moved in bodies]
    return [{n for n in below if n in moved or gltf.get("nodes", n).get("children")} for moved, below in walks]


def _build_armature(gltf: Gltf, joints: set[int], skins: list[int], animated: set[int]) -> parts.Armature:
    """Build the tree of a group's joints; its root is the topmost node above them that any animation moves."""
    nodes, bones = gltf.all("nodes"), set(read_bones(gltf).values())
    own = gltf.nodes.connect(joints)
    wanted = set(gltf.nodes.connect([*own, *(bones & set(gltf.nodes.walk(own[0])))]))
    moved = [node for node in gltf.nodes.line(own[0])[1:] if node in animated]
    if moved:
        wanted |= {node for node in gltf.nodes.line(own[0]) if moved[-1] in gltf.nodes.line(node)}
    order = [node for node in gltf.nodes.walk(moved[-1] if moved else own[0]) if node in wanted]
    if len(order) > parts.MAX_JOINTS:
        raise Refusal(f"an armature has {len(order)} joints, allowed are {parts.MAX_JOINTS}")
    index_of = {node: index for index, node in enumerate(order)}
    parents = tuple(-1 if node == order[0] else index_of[gltf.nodes.parent[node]] for node in order)
    ends = {}
    for node in order:
        children = nodes[node].get("children", ())
        tips = [child for child in children if child not in index_of and nodes[child].get("mesh") is None]
        if len(tips) == 1 and not any(child in index_of for child in children):
            ends[index_of[node]] = tips[0]
    above = [nodes[k] for k in (gltf.nodes.parent.get(order[0]), order[0]) if k is not None]  # exporters name it there
    named = [*(gltf.get("skins", skin) for skin in skins[:1]), *above]
    name = next((str(one["name"]) for one in named if one.get("name")), f"armature_{order[0]}")
    return parts.Armature(name, order, parents, ends, skins)


@dataclass(frozen=True, eq=False)
class Track:
    """Keys of one property of a node."""

    node: int
    path: str
    """translation, rotation or scale."""
    times: Array
    """(keys,) seconds, increasing."""
    values: Array
    """(keys, 3 or 4), or (3 keys, 3 or 4) with tangents for cubic splines."""
    interpolation: str

    def sample(self, times: Array) -> Array:
        """Return the values (times, 3 or 4) at times, seconds; before the first and after the last key it holds."""
        keys, is_spline = self.times, self.interpolation == "CUBICSPLINE"
        if len(keys) == 1:
            return np.tile(self.values[1 if is_spline else 0], (len(times), 1))
        low = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
        gap = np.maximum(keys[low + 1] - keys[low], 1e-12)
        share = np.clip((times - keys[low]) / gap, 0.0, 1.0)
        if is_spline:  # in-tangent, value and out-tangent
            table, t, gap = self.values.reshape(len(keys), 3, -1), share[:, None], gap[:, None]
            before, after = table[low, 1], table[low + 1, 1]
            leave, arrive = table[low, 2] * gap, table[low + 1, 0] * gap
            rise, bend = t * t * (3 - 2 * t), t * (1 - t)
            return before + (after - before) * rise + bend * ((1 - t) * leave - t * arrive)
        before, after = self.values[low], self.values[low + 1]
        if self.interpolation == "STEP":
            return np.where((share >= 1.0)[:, None], after, before)
        if self.path == "rotation":
            return rotations.slerp(*(torch.from_numpy(values) for values in (before, after, share))).numpy()
        return before + (after - before) * share[:, None]


def _name_animations(gltf: Gltf) -> list[str]:
    return parts.make_unique([str(a.get("name") or f"animation_{k}") for k, a in enumerate(gltf.all("animations"))])


def _time_animations(gltf: Gltf, nodes: Sequence[int]) -> dict[str, float]:
    """Return the seconds that each animation lasts that moves these nodes, by name, without those whose key times
    cannot be read."""
    found = {}
    for name, animation in zip(_name_animations(gltf), gltf.all("animations"), strict=True):
        with suppress(Refusal, IndexError, KeyError):
            targets = [(channel["sampler"], channel["target"]) for channel in animation.get("channels", ())]
            own = [k for k, target in targets if target.get("node") in nodes and target["path"] in _AT_REST]
            inputs = {animation["samplers"][sampler]["input"] for sampler in own}
            ends = [read_accessor(gltf, times, "SCALAR")[[0, -1], 0].tolist() for times in inputs]
            if ends:
                found[name] = max(end for _, end in ends) - min(start for start, _ in ends)
    return found


def _read_tracks(gltf: Gltf, animation: int, nodes: Sequence[int]) -> list[Track]:
    """Read the tracks of these nodes in an animation; empty where it moves none of them."""
    entry, found = gltf.get("animations", animation), []
    for channel in entry.get("channels", ()):
        node, path, number = channel["target"].get("node"), channel["target"]["path"], channel["sampler"]
        if node in nodes and path in _AT_REST:
            sampler = entry.get("samplers", [])[number]
            found.append(_read_track(gltf, node, path, sampler, f"animations[{animation}].samplers[{number}]"))
    return found


def _read_track(gltf: Gltf, node: int, path: str, sampler: Json, what: str) -> Track:
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise Refusal(f"{what}: no interpolation of glTF is {interpolation!r}")
    times = read_accessor(gltf, sampler["input"], "SCALAR")[:, 0].astype(np.float64)
    values = read_accessor(gltf, sampler["output"], _KINDS[len(_AT_REST[path])]).astype(np.float64)
    keys = len(times) * (3 if interpolation == "CUBICSPLINE" else 1)
    if len(values) != keys:
        raise Refusal(f"{what} has {len(times)} key times and {len(values)} values, expected {keys}")
    if (np.diff(times) < 0).any() or times[0] < 0 or times[-1] > 1e6:
        raise Refusal(f"{what}: key times must increase, from 0 to a million seconds")
    if path == "rotation" and interpolation != "CUBICSPLINE":
        lengths = np.linalg.norm(values, axis=1)
        if (abs(lengths - 1) > 0.1).any():
            raise Refusal(f"{what}: a rotation is no unit quaternion")
        values = values / lengths[:, None]
    return Track(node, path, times, values, interpolation)


def _sample_tracks(gltf: Gltf, nodes: Sequence[int], tracks: Sequence[Track]) -> tuple[Fraction, Array]:
    """Return frames per second, and local matrices (frames, nodes, 4, 4) at its frames, from the first key to the last.

    Refusal where there would be too many.
    """
    keys = np.concatenate([track.times for track in tracks])
    parts.check_poses(int(keys.max() - keys.min()), 1)
    fps, times = sample_times(keys)
    parts.check_poses(len(times), len(nodes))
    moved = {track.node for track in tracks}
    matrices = np.empty((len(times), len(nodes), 4, 4))
    for number, node in enumerate(nodes):
        own = gltf.get("nodes", node)
        if node not in moved:
            matrices[:, number] = _node_matrix(own)
            continue
        placed = {path: np.tile(values, (len(times), 1)) for path, values in _node_parts(own).items()}
        placed |= {track.path: track.sample(times) for track in tracks if track.node == node}
        matrices[:, number] = parts.compose_matrices(*placed.values())
    return fps, matrices


def _read_parts(gltf: Gltf, armature: parts.Armature) -> Iterator[parts.MeshPart]:
    """Read what the armature's skins carry, and what hangs on its joints rigidly."""
    index_of = {node: joint for joint, node in enumerate(armature.nodes)}
    for number, node in enumerate(gltf.all("nodes")):
        mesh, skin = node.get("mesh"), node.get("skin")
        if mesh is None:
            continue
        if skin is not None and skin in armature.skins:
            joints = np.array([index_of[node] for node in gltf.get("skins", skin)["joints"]])
            inverse = _read_inverse_binds(gltf, skin)
            matrices = np.tile(np.eye(4), (len(joints), 1, 1)) if inverse is None else inverse
        else:
            line = gltf.nodes.line(number)
            above = next((above for above in line if above in index_of), None)
            if above is None or skin is not None:
                continue
            joints, matrices = np.array([index_of[above]]), gltf.chain(line[: line.index(above)])[None]
        for k, primitive in enumerate(gltf.get("meshes", mesh).get("primitives", ())):
            what, attributes = f"meshes[{mesh}].primitives[{k}]", primitive["attributes"]
            if primitive.get("mode", 4) not in (_TRIANGLES, _STRIP, _FAN) or "POSITION" not in attributes:
                continue
            points = read_accessor(gltf, attributes["POSITION"], "VEC3").astype(np.float64)
            rows, shares = np.zeros((len(points), 1), np.int64), np.ones((len(points), 1))
            if skin is not None:
                rows, shares = _read_carriers(gltf, attributes, len(points), what)
            faces, rgba = _read_faces(gltf, primitive, len(points)), _read_colours(gltf, primitive, len(points), what)
            yield parts.MeshPart(points, faces, rgba, joints, matrices, rows, shares)


def _read_carriers(gltf: Gltf, attributes: Json, count: int, what: str) -> tuple[Array, Array]:
    """Return by vertex the indices among a skin's joints and their shares, (n, k) each."""
    sets = [n for n in range(4) if f"JOINTS_{n}" in attributes and f"WEIGHTS_{n}" in attributes]
    if not sets:
        raise Refusal(f"{what} has a skin and no JOINTS_0 and WEIGHTS_0")
    own, shares = (
        np.concatenate([read_accessor(gltf, attributes[f"{name}_{n}"], "VEC4") for n in sets], axis=1)
        for name in ("JOINTS", "WEIGHTS")
    )
    if own.shape != shares.shape or len(own) != count:
        raise Refusal(f"{what} has {count} vertices and {len(own)} rows of joints")
    return np.where(shares > 0, own, 0).astype(np.int64), parts.share_out(shares.astype(np.float64))


def _read_faces(gltf: Gltf, primitive: Json, count: int) -> Array:
    indices, mode = primitive.get("indices"), primitive.get("mode", _TRIANGLES)
    order = np.arange(count) if indices is None else read_accessor(gltf, indices, "SCALAR")[:, 0].astype(np.int64)
    if mode == _TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if mode == _STRIP:
        faces = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
        faces[1::2] = faces[1::2, ::-1]
        return faces
    return np.stack([np.full(max(len(order) - 2, 0), order[0]), order[1:-1], order[2:]], axis=1)


def _read_colours(gltf: Gltf, primitive: Json, count: int, what: str) -> Array:
    """Read the colours of a primitive's `count` vertices, (n, 4): sRGB and opacity, 0 to 1.

    Without the package pillow, or of a kind that it does not know, a picture's place is taken by the material's plain
    colour.
    """
    attributes = primitive["attributes"]
    material = {} if primitive.get("material") is None else gltf.get("materials", primitive["material"])
    look = material.get("pbrMetallicRoughness", {})
    linear = np.tile(np.array(look.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), np.float64), (count, 1))
    if "COLOR_0" in attributes:
        own = read_accessor(gltf, attributes["COLOR_0"], "VEC3", "VEC4").astype(np.float64)
        if len(own) != count:
            raise Refusal(f"{what} has {count} vertices and {len(own)} colours")
        linear[:, : own.shape[1]] *= own
    texture = look.get("baseColorTexture", {})
    name, picture = f"TEXCOORD_{texture.get('texCoord', 0)}", None
    if texture and name in attributes:
        picture = _read_picture(gltf, gltf.get("textures", texture["index"]).get("source"))
    if picture is not None:
        where = read_accessor(gltf, attributes[name], "VEC2").astype(np.float64)
        if len(where) != count:
            raise Refusal(f"{name} has {len(where)} rows for {count} vertices")
        texels = parts.sample_picture(picture, where)
        linear *= np.column_stack([parts.decode_srgb(texels[:, :3]), texels[:, 3]])
    opacity = linear[:, 3:] if material.get("alphaMode") == "BLEND" else np.ones((count, 1))
    return np.concatenate([parts.encode_srgb(linear[:, :3]), opacity], axis=1).clip(0.0, 1.0)


def _read_picture(gltf: Gltf, source: int | None) -> Array | None:
    """Read a picture from its own file or from a view; None where it is neither, or cannot be decoded."""
    image = {} if source is None else gltf.get("images", source)
    if image.get("uri") is not None:
        return parts.decode_picture(_read_neighbour(gltf.path, image["uri"]))
    return (
        None if image.get("bufferView") is None else parts.decode_picture(bytes(_read_view(gltf, image["bufferView"])))
    )


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion as .glb or .vrm: on the character whose file its skeleton came from, else on a mannequin; as .vrma
    without either.

    RequestError for a .vrm of a motion that is of no VRM character, for a .vrma of one whose bones are not known, and
    where the character's file has changed since it was read.
    """
    ending = PurePath(path).suffix.lower()
    if ending == ".vrma":
        return _save_bones(motion, path)
    source = character_of(motion, ending)
    if ending == ".vrm" and (source is None or not source.humanoid):
        raise RequestError(f"cannot write {path}: a .vrm needs a character, as by --rig hero.vrm")
    if source is None:
        write_bytes(path, _compose(motion))
    else:
        _save_character(motion, path, source)


def _save_character(motion: Motion, path: str | PathLike[str], source: CharacterSource) -> None:
    """Write the character's file with the motion as its first animation, named as the new file.

    Meshes, materials, skins, morphs, extensions and further nodes stay byte for byte, and so do the file's animations,
    but the one that the motion was read from is replaced. What a .gltf kept in other files is put into the one.
    """
    with parts.names_file(source.path), _refuse_malformed():
        gltf, tree, binary = _gather(source.path)
    arrays = _Arrays(tree, binary)
    nodes = [int(node) for node in source.nodes]
    if source.has_new_root:
        nodes[0] = _add_node_above(tree, nodes[1], source.frames.names[0])
    animation = _build_character_animation(motion, source, nodes, arrays, Path(path).stem)
    named = zip(tree.get("animations", []), _name_animations(gltf), strict=True)
    tree["animations"] = [animation, *(other for other, name in named if name != source.animation)]
    if motion.licence:
        asset = tree["asset"]
        extras = asset.get("extras")
        tree["asset"] = {**asset, "extras": {**(extras if isinstance(extras, dict) else {}), LICENCE: motion.licence}}
    first = tree["buffers"][0] if tree.get("buffers") else {}
    tree["buffers"] = [{**first, "byteLength": len(binary)}]
    write_bytes(path, _compose_glb(tree, binary))


def _gather(path: Path) -> tuple[Gltf, Json, bytearray]:
    """Read a file; also return a copy of the document with one buffer, and that: other files are put into it."""
    gltf = read_file(path)
    tree, binary, starts = copy.deepcopy(gltf.tree), bytearray(), list[int]()

    def append(data: bytes) -> int:
        start = len(binary)
        binary.extend(data + bytes(-len(data) % 4))
        return start

    for buffer, data in zip(tree.get("buffers", []), gltf.buffers, strict=True):
        starts.append(append(data if buffer.get("uri") is None else data[: buffer["byteLength"]]))
    for number, view in enumerate(tree.get("bufferViews", [])):
        if view["buffer"] >= len(starts):
            raise RequestError(f"{gltf.path}: bufferViews[{number}] is of buffer {view['buffer']} of {len(starts)}")
        if starts[view["buffer"]]:
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
        view["buffer"] = 0
    if tree.get("buffers"):
        tree["buffers"] = [{key: value for key, value in tree["buffers"][0].items() if key != "uri"}]
    for image in tree.get("images", ()):
        if "uri" in image:
            data = _read_neighbour(gltf.path, image.pop("uri"))
            image.setdefault("mimeType", next((m for magic, m in _MIME.items() if data.startswith(magic)), "image/png"))
            views = tree.setdefault("bufferViews", [])
            image["bufferView"] = len(views)
            views.append({"buffer": 0, "byteOffset": append(data), "byteLength": len(data)})
    return gltf, tree, binary


def _compose_glb(tree: Json, binary: bytearray) -> bytes:
    """Compose a .glb file of a document and its binary chunk, of a multiple of 4 bytes."""
    text = json.dumps(tree, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = [_CHUNK.pack(len(text), b"JSON"), text]
    if binary:
        chunks += [_CHUNK.pack(len(binary), b"BIN\0"), binary]
    return b"".join([_HEADER.pack(b"glTF", 2, _HEADER.size + sum(map(len, chunks))), *chunks])


class _Arrays:
    """Arrays that are added to a document and its buffer."""

    def __init__(self, tree: Json, binary: bytearray):
        self.tree, self.binary = tree, binary

    def add(self, values: Array, target: int | None = None) -> int:
        """Add numbers, (n,) or (n, width), floats with 32 bits, with least and greatest; return the accessor."""
        table = np.ascontiguousarray(values, np.float32 if values.dtype.kind == "f" else None).reshape(len(values), -1)
        views, accessors = self.tree.setdefault("bufferViews", []), self.tree.setdefault("accessors", [])
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": table.nbytes})
        if target is not None:
            views[-1]["target"] = target
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": _COMPONENT[table.dtype.name],
                "count": len(table),
                "type": _KINDS[table.shape[1]],
                "min": table.min(0).tolist(),
                "max": table.max(0).tolist(),
            }
        )
        self.binary += table.tobytes()
        return len(accessors) - 1


def _build_character_animation(
    motion: Motion, source: CharacterSource, nodes: Sequence[int], arrays: _Arrays, name: str
) -> Json:
    moved, turned = source.frames.to_locals(motion)
    times = np.arange(motion.num_frames) / float(motion.fps)
    still, every = arrays.add(times[:1]), arrays.add(times)
    animation: Json = {"name": name, "channels": [], "samplers": []}
    for joint, node in enumerate(nodes):
        own = arrays.tree["nodes"][node]
        _use_parts(own)
        if source.frames.scales[joint] < 0:
            turned[:, joint] = _beside_own_scale(own, turned[:, joint])
        for path, values in (("translation", moved[:, joint]), ("rotation", turned[:, joint])):
            constant = bool((np.ptp(values, axis=0) < _STILL).all())
            usual = np.array(own.get(path, _AT_REST[path]))
            if constant and path == "translation" and np.allclose(values[0], usual, rtol=1e-6, atol=1e-6):
                continue
            output = arrays.add(values[:1] if constant else values)
            _add_channel(animation, node, path, still if constant else every, output)
    return animation


def _add_node_above(tree: Json, node: int, name: str) -> int:
    """Put a node that does nothing above a node, in its place among its parent's children or in the scenes."""
    tree["nodes"].append({"name": name, "children": [node]})
    added = len(tree["nodes"]) - 1
    holders = [n.get("children", []) for n in tree["nodes"][:-1]] + [s.get("nodes", []) for s in tree.get("scenes", [])]
    for holder in holders:
        holder[:] = [added if child == node else child for child in holder]
    return added


def _beside_own_scale(node: Json, turned: Array) -> Array:
    """Return rotations (frames, 4) that go with the scale of a node that mirrors, along whichever axes, of those that
    go with one of -1 along all."""
    own = torch.tensor(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=torch.float64)
    matrix = parts.compose_matrices(np.zeros(3), own.numpy(), np.array(node["scale"]))
    rest = rotations.from_matrix(torch.from_numpy(parts.split_scale(matrix, may_mirror=True)[0]))
    change = rotations.multiply(rotations.inverse(rest), own)
    return rotations.multiply(torch.from_numpy(turned), change).numpy()


def _use_parts(node: Json) -> None:
    """Replace a node's matrix, which no animation may move, by translation, rotation and scale."""
    if "matrix" not in node:
        return
    matrix = np.array(node.pop("matrix"), np.float64).reshape(4, 4).T
    turn, scale = parts.split_scale(matrix, may_mirror=True)
    node["translation"] = matrix[:3, 3].tolist()
    node["rotation"] = rotations.from_matrix(torch.from_numpy(turn)).tolist()
    node["scale"] = [scale] * 3


def _add_channel(animation: Json, node: int, path: str, times: int, values: int) -> None:
    animation["channels"].append({"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}})
    animation["samplers"].append({"input": times, "output": values, "interpolation": "LINEAR"})


def _compose(motion: Motion, bones: Mapping[str, int] | None = None, root_at_rest: list[float] | None = None) -> bytes:
    """Compose a file on a mannequin.

    With `bones`, the joint by VRM's name of a bone, it is a VRM animation, without the mannequin; `root_at_rest` is
    then the position of the root in the T-pose, metres.
    """
    licence: Json = {"copyright": motion.licence, "extras": {LICENCE: motion.licence}} if motion.licence else {}
    tree: Json = {
        "asset": {"version": "2.0", "generator": f"mapctl {__version__}", **licence},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": _build_nodes(motion),
    }
    arrays = _Arrays(tree, bytearray())
    if bones is None:
        _add_body(motion, tree, arrays)
    else:
        tree["nodes"][0]["translation"] = root_at_rest
        tree["extensionsUsed"] = [ANIMATION]
        humanoid = {"humanBones": {bone: {"node": node} for bone, node in bones.items()}}
        tree["extensions"] = {ANIMATION: {"specVersion": "1.0", "humanoid": humanoid}}
    tree["animations"] = [_build_animation(motion, arrays)]
    tree["buffers"] = [{"byteLength": len(arrays.binary)}]
    return _compose_glb(tree, arrays.binary)


def _build_nodes(motion: Motion) -> list[Json]:
    """Build a node for each joint, in file order, then one for each End Site."""
    skeleton, offsets = motion.skeleton, all_translations(motion)[0]
    below = [skeleton.children(joint) for joint in range(motion.num_joints)]
    for number, name in enumerate(skeleton.end_offsets):
        below[skeleton.index(name)].append(motion.num_joints + number)
    joints = [
        {"name": name, "translation": offset.tolist()} | ({"children": children} if children else {})
        for name, children, offset in zip(skeleton.names, below, offsets, strict=True)
    ]
    ends = [{"name": f"{name}_end", "translation": list(at)} for name, at in skeleton.end_offsets.items()]
    return [*joints, *ends]


def _add_body(motion: Motion, tree: Json, arrays: _Arrays) -> None:
    """Add the skinned mesh of the motion's body."""
    joints, (name, body) = motion.num_joints, build_skinned_body(motion)
    missing = ((0, 0), (0, 4 - body.joints.shape[1]))
    weight = np.pad(body.weights, missing).astype(np.float32)
    weight /= weight.sum(axis=1, keepdims=True)
    columns = {
        "POSITION": body.vertices,
        "NORMAL": body.normals,
        "COLOR_0": parts.decode_srgb(body.rgba[:, :3]),
        "JOINTS_0": np.pad(body.joints, missing).astype(np.uint16),
        "WEIGHTS_0": weight,
    }
    attributes = {name: arrays.add(values, _ARRAY_BUFFER) for name, values in columns.items()}
    faces = arrays.add(body.faces.reshape(-1).astype(np.uint32), _ELEMENT_ARRAY_BUFFER)
    tree["meshes"] = [{"name": name, "primitives": [{"attributes": attributes, "indices": faces, "material": 0}]}]
    inverse = np.tile(np.eye(4, dtype=np.float32), (joints, 1, 1))  # column-major: a translation is the last row here
    frames = np.tile(np.eye(3), (joints, 1, 1)) if body.frames is None else body.frames
    inverse[:, :3, :3], inverse[:, 3, :3] = frames, -np.einsum("jba,jb->ja", frames, body.rest)
    binds = arrays.add(inverse.reshape(joints, 16))
    tree["skins"] = [{"joints": list(range(joints)), "skeleton": 0, "inverseBindMatrices": binds}]
    look = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    tree["materials"] = [{"name": "mannequin", "pbrMetallicRoughness": look}]
    tree["scenes"][0]["nodes"].append(len(tree["nodes"]))
    tree["nodes"].append({"name": "mannequin", "mesh": 0, "skin": 0})


def _build_animation(motion: Motion, arrays: _Arrays) -> Json:
    times = arrays.add(np.arange(motion.num_frames) / float(motion.fps))
    animation: Json = {"name": "motion", "channels": [], "samplers": []}
    for joint, values in {0: motion.root_position, **motion.moving_offsets}.items():
        _add_channel(animation, joint, "translation", times, arrays.add(values.numpy()))
    for joint, values in enumerate(make_sign_continuous(motion.local_quat_xyzw).unbind(1)):
        _add_channel(animation, joint, "rotation", times, arrays.add(values.numpy()))
    return animation


def _save_bones(motion: Motion, path: str | PathLike[str]) -> None:
    """Write the motion of a VRM character's bones, or of the canonical joints. RequestError for other motions."""
    bones = _find_bones(motion)
    if "hips" not in bones:
        needed = "needs the motion of a VRM or of canonical joints; `mapctl convert` makes one of any other file"
        raise RequestError(f"cannot write {path}: a .vrma {needed}")
    body, hips = _select_bones(motion, bones, path)
    of_joint = {joint: bone for bone, joint in bones.items()}
    order = {of_joint[motion.skeleton.index(name)]: node for node, name in enumerate(body.skeleton.names)}
    write_bytes(path, _compose(body, order, hips))


def _find_bones(motion: Motion) -> dict[str, int]:
    """Return the joint of each bone, by VRM 1's name; empty without a humanoid."""
    source = motion.source
    if not isinstance(source, CharacterSource) or not source.humanoid or not source.holds(motion):
        return {name: j for j, name in enumerate(CANONICAL.names)} if motion.skeleton.names == CANONICAL.names else {}
    source.check_unchanged()
    bones = read_bones(read_file(source.path))
    renamed = _THUMBS if "leftThumbIntermediate" in bones or "rightThumbIntermediate" in bones else {}
    named = {next((b.replace(old, new) for old, new in renamed.items() if old in b), b): n for b, n in bones.items()}
    joints = {node: joint for joint, node in enumerate(source.nodes)}
    return {bone: joints[node] for bone, node in named.items() if node in joints and not bone.endswith("Eye")}


def _select_bones(motion: Motion, bones: Mapping[str, int], path: str | PathLike[str]) -> tuple[Motion, list[float]]:
    """Return the motion of the bones alone, the hips first, and where these are at rest in the world."""
    whole, rest = motion.skeleton, Motion.at_rest(motion.skeleton).joint_positions()[0]
    hips = bones["hips"]
    joints = [hips, *sorted(set(bones.values()) - {hips})]
    parents = [-1, *(_nearest_above(whole, joint, joints) for joint in joints[1:])]
    ends = {name: end for name, end in whole.end_offsets.items() if whole.index(name) in joints}
    if isinstance(motion.source, CharacterSource):
        height = torch.from_numpy(motion.source.frames.positions[hips].copy())
    else:
        tips = [rest[whole.index(name)] + torch.tensor(end, dtype=rest.dtype) for name, end in ends.items()]
        height = torch.tensor([0.0, float(rest[hips, 1] - torch.stack([*rest, *tips])[:, 1].min()), 0.0])
    offsets = torch.stack([rest[j] - rest[joints[max(p, 0)]] for j, p in zip(joints, parents, strict=True)])
    world, positions = motion.joint_rotations()[:, joints], motion.joint_positions()[:, joints]
    if rest[bones["leftUpperLeg"], 0] < rest[bones["rightUpperLeg"], 0]:  # VRM 0 faces -Z
        flip = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)
        offsets, positions, height = offsets * flip, positions * flip, height * flip
        ends = {name: (-x, y, -z) for name, (x, y, z) in ends.items()}
        world = rotations.multiply(rotations.multiply(_HALF_TURN, world), rotations.inverse(_HALF_TURN))
    local = rotations.make_sign_continuous(kinematics.local_from_world(tuple(parents), world))
    skeleton = Skeleton(tuple(whole.names[joint] for joint in joints), tuple(parents), offsets, ends)
    body = Motion(skeleton, motion.fps, positions[:, 0].clone(), local, licence=motion.licence)
    lost = float((body.joint_positions() - positions).norm(dim=-1).max())
    if lost > _STILL_METRES:
        warn_once(
            f"{path}: only the hips of a .vrma travel; bones whose length changes are up to {100 * lost:.1f} cm off"
        )
    return body, height.tolist()


def _nearest_above(skeleton: Skeleton, joint: int, joints: list[int]) -> int:
    """Return the position among `joints` of the nearest of them above a joint; the first, the hips, where none is."""
    above = skeleton.parents[joint]
    while above >= 0 and above not in joints:
        above = skeleton.parents[above]
    return joints.index(above) if above >= 0 else 0
