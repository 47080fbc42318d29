"""glTF and VRM out: a user's own character with an animation added; all else of its file stays as it is."""

import copy
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mapctl import rotations
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_pieces
from mapctl.formats.characters.rest_frames import compose_matrices, split_scale
from mapctl.formats.characters.source import CharacterSource
from mapctl.formats.gltf.animations import name_animations
from mapctl.formats.gltf.container import GltfFile, compose_glb, read_file, read_neighbour
from mapctl.formats.gltf.schema import LICENCE
from mapctl.motion import Motion

Array = np.ndarray
_STILL = 1e-6  # metres and quaternion components that vary less than this need one key
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MIME = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX": "image/ktx2"}


def save(motion: Motion, path: str | PathLike[str], source: CharacterSource) -> None:
    """Write the character's file with the motion as its first animation, named as the new file.

    Meshes, materials, skins, morphs, extensions and further nodes stay byte for byte, and so do the file's animations,
    but the one that the motion was read from is replaced. What a .gltf kept in other files is put into the one.
    RequestError where the character's file has changed since it was read.
    """
    source.check_unchanged()
    gltf = read_file(source.path)
    tree, binary = _gather(gltf)
    appended = _Appended(tree, sum(len(piece) for piece in binary))
    nodes = [int(node) for node in source.nodes]
    if source.has_new_root:
        nodes[0] = _add_node_above(tree, nodes[1], source.frames.names[0])
    animation = _build_animation(motion, source, nodes, tree, appended, Path(path).stem)
    kept = [
        a for a, name in zip(tree.get("animations", []), name_animations(gltf), strict=True) if name != source.animation
    ]
    tree["animations"] = [animation, *kept]
    if motion.licence:
        asset = tree["asset"]
        tree["asset"] = {**asset, "extras": {**_find_extras(asset), LICENCE: motion.licence}}
    first = tree["buffers"][0] if tree.get("buffers") else {}
    tree["buffers"] = [{**first, "byteLength": appended.size}]
    write_pieces(path, compose_glb(tree, [*binary, *appended.pieces]))


def _find_extras(asset: dict[str, Any]) -> dict[str, Any]:
    extras = asset.get("extras")
    return extras if isinstance(extras, dict) else {}


def _gather(gltf: GltfFile) -> "tuple[dict[str, Any], list[bytes | memoryview]]":
    """Return a copy of the document with one buffer, and that buffer's pieces; other files are put into it."""
    tree = copy.deepcopy(gltf.tree)
    pieces: list[bytes | memoryview] = []
    starts, size = [], 0
    for number, data in enumerate(gltf.buffers):
        length = len(data) if number == 0 and data is gltf.binary else gltf.document.buffers[number].byteLength
        pieces += [data[:length], bytes(-length % 4)]
        starts.append(size)
        size += length + -length % 4
    for number, view in enumerate(tree.get("bufferViews", [])):
        if view["buffer"] >= len(starts):
            raise RequestError(f"{gltf.path}: bufferViews[{number}] is of buffer {view['buffer']} of {len(starts)}")
        if starts[view["buffer"]]:
            view["byteOffset"] = view.get("byteOffset", 0) + starts[view["buffer"]]
        view["buffer"] = 0
    if tree.get("buffers"):
        tree["buffers"] = [{key: value for key, value in tree["buffers"][0].items() if key != "uri"}]
    for image in tree["images"] if gltf.document.images else ():
        if "uri" in image:
            size = _embed_image(gltf, tree, image, pieces, size)
    return tree, [piece for piece in pieces if len(piece)]


def _embed_image(
    gltf: GltfFile, tree: dict[str, Any], image: dict[str, Any], pieces: "list[bytes | memoryview]", size: int
) -> int:
    """Put a picture that lay beside the document into the buffer; return the buffer's new size."""
    data = read_neighbour(gltf.path, image.pop("uri"))
    kind = next((mime for magic, mime in _MIME.items() if data.startswith(magic)), "image/png")
    image.setdefault("mimeType", kind)
    views = tree.setdefault("bufferViews", [])
    image["bufferView"] = len(views)
    views.append({"buffer": 0, "byteOffset": size, "byteLength": len(data)})
    pieces += [data, bytes(-len(data) % 4)]
    return size + len(data) + -len(data) % 4


class _Appended:
    """Arrays that are added to a document and its buffer."""

    def __init__(self, tree: dict[str, Any], size: int):
        self.tree, self.size, self.pieces = tree, size, list[bytes]()

    def add(self, values: Array) -> int:
        """Add numbers, (n,) or (n, width), with least and greatest; return the index of the new accessor."""
        table = np.ascontiguousarray(values, np.float32).reshape(len(values), -1)
        views, accessors = self.tree.setdefault("bufferViews", []), self.tree.setdefault("accessors", [])
        views.append({"buffer": 0, "byteOffset": self.size, "byteLength": table.nbytes})
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": 5126,
                "count": len(table),
                "type": _KINDS[table.shape[1]],
                "min": table.min(0).tolist(),
                "max": table.max(0).tolist(),
            }
        )
        self.pieces.append(table.tobytes())
        self.size += table.nbytes
        return len(accessors) - 1


def _build_animation(
    motion: Motion, source: CharacterSource, nodes: Sequence[int], tree: dict[str, Any], appended: _Appended, name: str
) -> dict[str, Any]:
    moved, turned = source.frames.to_locals(motion)
    times = np.arange(motion.num_frames) / float(motion.fps)
    still, every = appended.add(times[:1]), appended.add(times)
    animation: dict[str, Any] = {"name": name, "channels": [], "samplers": []}
    for joint, node in enumerate(nodes):
        own = tree["nodes"][node]
        _use_parts(own)
        if source.frames.scales[joint] < 0:
            turned[:, joint] = _beside_own_scale(own, turned[:, joint])
        for path, values in (("translation", moved[:, joint]), ("rotation", turned[:, joint])):
            constant = bool((np.ptp(values, axis=0) < _STILL).all())
            usual = np.array(own.get(path, (0.0, 0.0, 0.0) if path == "translation" else (0.0, 0.0, 0.0, 1.0)))
            if constant and path == "translation" and np.allclose(values[0], usual, rtol=1e-6, atol=1e-6):
                continue
            output = appended.add(values[:1] if constant else values)
            animation["channels"].append(
                {"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}}
            )
            animation["samplers"].append(
                {"input": still if constant else every, "output": output, "interpolation": "LINEAR"}
            )
    return animation


def _add_node_above(tree: dict[str, Any], node: int, name: str) -> int:
    """Put a node that does nothing above a node, in its place among its parent's children or in the scenes."""
    tree["nodes"].append({"name": name, "children": [node]})
    added = len(tree["nodes"]) - 1
    for holder in (
        *(n.get("children", []) for n in tree["nodes"][:-1]),
        *(s.get("nodes", []) for s in tree.get("scenes", [])),
    ):
        holder[:] = [added if child == node else child for child in holder]
    return added


def _beside_own_scale(node: dict[str, Any], turned: Array) -> Array:
    """Return rotations (frames, 4) that go with the scale of a node that mirrors, along whichever axes, of those that
    go with one of -1 along all."""
    own = torch.tensor(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=torch.float64)
    matrix = compose_matrices(np.zeros(3), own.numpy(), np.array(node["scale"]))
    rest = rotations.from_matrix(torch.from_numpy(split_scale(matrix, may_mirror=True)[0]))
    change = rotations.multiply(rotations.inverse(rest), own)
    return rotations.multiply(torch.from_numpy(turned), change.expand(len(turned), 4)).numpy()


def _use_parts(node: dict[str, Any]) -> None:
    """Replace a node's matrix, which no animation may move, by translation, rotation and scale."""
    if "matrix" not in node:
        return
    matrix = np.array(node.pop("matrix"), np.float64).reshape(4, 4).T
    turn, scale = split_scale(matrix, may_mirror=True)
    node["translation"] = matrix[:3, 3].tolist()
    node["rotation"] = rotations.from_matrix(torch.from_numpy(turn)).tolist()
    node["scale"] = [scale] * 3
