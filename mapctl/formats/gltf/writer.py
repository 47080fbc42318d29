"""glTF, VRM and VRM animations out: on a user's own character, whose file stays as it is but for an animation, or on a
mannequin. Metres, Y up; every joint has a rotation track at the motion's own frames, one that travels a translation.

VRM animations follow VRMC_vrm_animation 1.0: the bones of a humanoid alone, at rest a T-pose that faces +Z; only the
hips travel, no node is scaled, and eyes are none of the bones.
"""

import copy
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path, PurePath

import numpy as np
import torch

from mapctl import kinematics, rotations
from mapctl.errors import RequestError
from mapctl.formats.atomic import write_pieces
from mapctl.formats.bvh import check_finite
from mapctl.formats.character import CharacterSource, build_skinned_body, character_of, compose_matrices, split_scale
from mapctl.formats.gltf.document import GltfFile, Json, compose_glb, read_file, read_neighbour, refuse_malformed
from mapctl.formats.gltf.reader import ANIMATION, LICENCE, name_animations, read_bones
from mapctl.formats.text import warn_once
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.skeleton import CANONICAL, Skeleton
from mapctl.version import __version__

Array = np.ndarray
_STILL = 1e-6  # metres and quaternion components that vary less than this need one key
_MIME = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX": "image/ktx2"}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENT = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_THUMBS = {"ThumbProximal": "ThumbMetacarpal", "ThumbIntermediate": "ThumbProximal"}
"""Bones of VRM 0 that have another name in VRM 1."""
_HALF_TURN = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
_STILL_METRES = 1e-3


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion as .glb or .vrm: on the character whose file its skeleton came from, else on a mannequin; as .vrma
    without either.

    RequestError where the motion holds a NaN, for a .vrm of a motion that is of no VRM character, and for a .vrma of
    one whose bones are not known.
    """
    check_finite(motion, path)
    ending = PurePath(path).suffix.lower()
    if ending == ".vrma":
        return _save_bones(motion, path)
    source = character_of(motion, ending)
    if ending == ".vrm" and (source is None or not source.humanoid):
        raise RequestError(f"cannot write {path}: a .vrm needs a character, as by --rig hero.vrm")
    if source is None:
        write_pieces(path, _compose(motion))
    else:
        _save_character(motion, path, source)


def _save_character(motion: Motion, path: str | PathLike[str], source: CharacterSource) -> None:
    """Write the character's file with the motion as its first animation, named as the new file.

    Meshes, materials, skins, morphs, extensions and further nodes stay byte for byte, and so do the file's animations,
    but the one that the motion was read from is replaced. What a .gltf kept in other files is put into the one.
    RequestError where the character's file has changed since it was read.
    """
    source.check_unchanged()
    gltf, tree, binary = _gather(source.path)
    appended = _Arrays(tree, sum(len(piece) for piece in binary))
    nodes = [int(node) for node in source.nodes]
    if source.has_new_root:
        nodes[0] = _add_node_above(tree, nodes[1], source.frames.names[0])
    animation = _build_character_animation(motion, source, nodes, tree, appended, Path(path).stem)
    kept = [
        a for a, name in zip(tree.get("animations", []), name_animations(gltf), strict=True) if name != source.animation
    ]
    tree["animations"] = [animation, *kept]
    if motion.licence:
        asset = tree["asset"]
        extras = asset.get("extras")
        tree["asset"] = {**asset, "extras": {**(extras if isinstance(extras, dict) else {}), LICENCE: motion.licence}}
    first = tree["buffers"][0] if tree.get("buffers") else {}
    tree["buffers"] = [{**first, "byteLength": appended.size}]
    write_pieces(path, compose_glb(tree, [*binary, *appended.pieces]))


@refuse_malformed
def _gather(path: Path) -> tuple[GltfFile, Json, list[bytes]]:
    """Read a file; also return a copy of the document with one buffer, and that buffer's pieces: other files are put
    into it."""
    gltf = read_file(path)
    tree = copy.deepcopy(gltf.tree)
    pieces: list[bytes] = []
    starts, size = [], 0
    for number, data in enumerate(gltf.buffers):
        length = len(data) if tree["buffers"][number].get("uri") is None else tree["buffers"][number]["byteLength"]
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
    for image in tree.get("images", ()):
        if "uri" in image:
            size = _embed_image(gltf, tree, image, pieces, size)
    return gltf, tree, [piece for piece in pieces if len(piece)]


def _embed_image(gltf: GltfFile, tree: Json, image: Json, pieces: list[bytes], size: int) -> int:
    """Put a picture that lay beside the document into the buffer; return the buffer's new size."""
    data = read_neighbour(gltf.path, image.pop("uri"))
    kind = next((mime for magic, mime in _MIME.items() if data.startswith(magic)), "image/png")
    image.setdefault("mimeType", kind)
    views = tree.setdefault("bufferViews", [])
    image["bufferView"] = len(views)
    views.append({"buffer": 0, "byteOffset": size, "byteLength": len(data)})
    pieces += [data, bytes(-len(data) % 4)]
    return size + len(data) + -len(data) % 4


class _Arrays:
    """Arrays that are added to a document and its buffer."""

    def __init__(self, tree: Json, size: int):
        self.tree, self.size, self.pieces = tree, size, list[bytes]()

    def add(self, values: Array, target: int | None = None) -> int:
        """Add numbers, (n,) or (n, width), floats with 32 bits, with least and greatest; return the index of the new
        accessor."""
        table = np.ascontiguousarray(values, np.float32 if values.dtype.kind == "f" else None).reshape(len(values), -1)
        views, accessors = self.tree.setdefault("bufferViews", []), self.tree.setdefault("accessors", [])
        views.append({"buffer": 0, "byteOffset": self.size, "byteLength": table.nbytes})
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
        self.pieces.append(table.tobytes())
        self.size += table.nbytes
        return len(accessors) - 1


def _build_character_animation(
    motion: Motion, source: CharacterSource, nodes: Sequence[int], tree: Json, appended: _Arrays, name: str
) -> Json:
    moved, turned = source.frames.to_locals(motion)
    times = np.arange(motion.num_frames) / float(motion.fps)
    still, every = appended.add(times[:1]), appended.add(times)
    animation: Json = {"name": name, "channels": [], "samplers": []}
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
            _add_channel(animation, node, path, still if constant else every, output)
    return animation


def _add_node_above(tree: Json, node: int, name: str) -> int:
    """Put a node that does nothing above a node, in its place among its parent's children or in the scenes."""
    tree["nodes"].append({"name": name, "children": [node]})
    added = len(tree["nodes"]) - 1
    for holder in (
        *(n.get("children", []) for n in tree["nodes"][:-1]),
        *(s.get("nodes", []) for s in tree.get("scenes", [])),
    ):
        holder[:] = [added if child == node else child for child in holder]
    return added


def _beside_own_scale(node: Json, turned: Array) -> Array:
    """Return rotations (frames, 4) that go with the scale of a node that mirrors, along whichever axes, of those that
    go with one of -1 along all."""
    own = torch.tensor(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), dtype=torch.float64)
    matrix = compose_matrices(np.zeros(3), own.numpy(), np.array(node["scale"]))
    rest = rotations.from_matrix(torch.from_numpy(split_scale(matrix, may_mirror=True)[0]))
    change = rotations.multiply(rotations.inverse(rest), own)
    return rotations.multiply(torch.from_numpy(turned), change.expand(len(turned), 4)).numpy()


def _use_parts(node: Json) -> None:
    """Replace a node's matrix, which no animation may move, by translation, rotation and scale."""
    if "matrix" not in node:
        return
    matrix = np.array(node.pop("matrix"), np.float64).reshape(4, 4).T
    turn, scale = split_scale(matrix, may_mirror=True)
    node["translation"] = matrix[:3, 3].tolist()
    node["rotation"] = rotations.from_matrix(torch.from_numpy(turn)).tolist()
    node["scale"] = [scale] * 3


def _add_channel(animation: Json, node: int, path: str, times: int, values: int) -> None:
    animation["channels"].append({"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}})
    animation["samplers"].append({"input": times, "output": values, "interpolation": "LINEAR"})


def _compose(
    motion: Motion, bones: Mapping[str, int] | None = None, root_at_rest: list[float] | None = None
) -> list[bytes]:
    """Compose the pieces of a file on a mannequin.

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
    arrays = _Arrays(tree, 0)
    if bones is None:
        _add_body(motion, tree, arrays)
    else:
        tree["nodes"][0]["translation"] = root_at_rest
        tree["extensionsUsed"] = [ANIMATION]
        humanoid = {"humanBones": {bone: {"node": node} for bone, node in bones.items()}}
        tree["extensions"] = {ANIMATION: {"specVersion": "1.0", "humanoid": humanoid}}
    tree["animations"] = [_build_animation(motion, arrays)]
    tree["buffers"] = [{"byteLength": arrays.size}]
    return compose_glb(tree, arrays.pieces)


def _build_nodes(motion: Motion) -> list[Json]:
    """Build a node for each joint, in file order, then one for each End Site."""
    skeleton, offsets = motion.skeleton, motion.skeleton.offsets.clone()
    offsets[0] = motion.root_position[0]
    for joint, track in motion.moving_offsets.items():
        offsets[joint] = track[0]
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
    joints, body = motion.num_joints, build_skinned_body(motion)
    missing = ((0, 0), (0, 4 - body.joints.shape[1]))
    weight = np.pad(body.weights, missing).astype(np.float32)
    weight /= weight.sum(axis=1, keepdims=True)
    columns = {
        "POSITION": body.vertices,
        "NORMAL": body.normals,
        "COLOR_0": body.linear_rgb,
        "JOINTS_0": np.pad(body.joints, missing).astype(np.uint16),
        "WEIGHTS_0": weight,
    }
    attributes = {name: arrays.add(values, _ARRAY_BUFFER) for name, values in columns.items()}
    faces = arrays.add(body.faces.reshape(-1).astype(np.uint32), _ELEMENT_ARRAY_BUFFER)
    tree["meshes"] = [{"name": body.name, "primitives": [{"attributes": attributes, "indices": faces, "material": 0}]}]
    inverse = np.tile(np.eye(4, dtype=np.float32), (joints, 1, 1))
    inverse[:, 3, :3] = -body.rest  # column-major: the translation is the last row here
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
    write_pieces(path, _compose(body, order, hips))


def _find_bones(motion: Motion) -> dict[str, int]:
    """Return the joint of each bone, by VRM 1's name; empty where nothing says which is which."""
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
    whole = motion.skeleton
    rest = whole.offsets.clone()
    for joint, parent in enumerate(whole.parents[1:], start=1):
        rest[joint] += rest[parent]
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
    world, places = motion.joint_rotations()[:, joints], motion.joint_positions()[:, joints]
    if rest[bones["leftUpperLeg"], 0] < rest[bones["rightUpperLeg"], 0]:  # VRM 0 faces -Z
        flip = torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64)
        offsets, places, height = offsets * flip, places * flip, height * flip
        ends = {name: (-x, y, -z) for name, (x, y, z) in ends.items()}
        turn = _HALF_TURN.expand_as(world)
        world = rotations.multiply(rotations.multiply(turn, world), rotations.inverse(turn))
    local = rotations.make_sign_continuous(kinematics.local_from_world(tuple(parents), world))
    skeleton = Skeleton(tuple(whole.names[joint] for joint in joints), tuple(parents), offsets, ends)
    body = Motion(skeleton, motion.fps, places[:, 0].clone(), local, licence=motion.licence)
    lost = float((body.joint_positions() - places).norm(dim=-1).max())
    if lost > _STILL_METRES:
        warn_once(
            f"{path}: only the hips of a .vrma travel; bones whose length changes are up to {100 * lost:.1f} cm off"
        )
    return body, height.tolist()


def _nearest_above(skeleton: Skeleton, joint: int, joints: list[int]) -> int:
    """Return the place among `joints` of the nearest of them above a joint; the first, the hips, where none is."""
    above = skeleton.parents[joint]
    while above >= 0 and above not in joints:
        above = skeleton.parents[above]
    return joints.index(above) if above >= 0 else 0
