"""glTF 2.0 binary out: the skeleton, its animation, and the mannequin as a skinned mesh.

Metres, Y up, as glTF wants. Joints are nodes with their file's names; a joint that travels, the root among them, has a
translation track, every joint a rotation track at the motion's own frames.
"""

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
import pygltflib

from mapctl.errors import RequestError
from mapctl.formats.atomic import write_bytes
from mapctl.formats.gltf import vrm
from mapctl.formats.gltf.schema import LICENCE
from mapctl.formats.skinned import SkinnedBody, build_skinned_body
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.version import __version__

_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENT = {"float32": pygltflib.FLOAT, "uint16": pygltflib.UNSIGNED_SHORT, "uint32": pygltflib.UNSIGNED_INT}


class _Buffer:
    """The one binary buffer of a file, filled array by array."""

    def __init__(self, document: pygltflib.GLTF2):
        self.document, self.blob = document, bytearray()

    def add(self, values: np.ndarray, target: int | None = None) -> int:
        """Add values, (n,) or (n, width), with least and greatest; return the index of the new accessor."""
        table = np.ascontiguousarray(values).reshape(len(values), -1)
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=table.nbytes, target=target)
        self.blob += table.tobytes()
        self.blob += bytes(-len(self.blob) % 4)
        self.document.bufferViews.append(view)
        self.document.accessors.append(
            pygltflib.Accessor(
                bufferView=len(self.document.bufferViews) - 1,
                componentType=_COMPONENT[table.dtype.name],
                count=len(table),
                type=_KINDS[table.shape[1]],
                min=table.min(0).tolist(),
                max=table.max(0).tolist(),
            )
        )
        return len(self.document.accessors) - 1


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write the motion with its skinned mannequin. Same motion, same bytes. RequestError where it holds a NaN."""
    write_bytes(path, to_bytes(motion, path=path))


def to_bytes(
    motion: Motion,
    *,
    path: str | PathLike[str] = "a .glb file",
    bones: Mapping[str, int] | None = None,
    root_at_rest: list[float] | None = None,
) -> bytes:
    """Return the content of the file; `path` is what an error names.

    With `bones`, the joint by VRM's name of a bone, it is a VRM animation, without the mannequin; `root_at_rest` is
    then the position of the root in the T-pose, metres.
    """
    if not (motion.root_position.isfinite().all() and motion.local_quat_xyzw.isfinite().all()):
        raise RequestError(f"cannot write {path}: the motion is not finite")
    told: dict[str, Any] = {"copyright": motion.licence, "extras": {LICENCE: motion.licence}} if motion.licence else {}
    document = pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0", generator=f"mapctl {__version__}", **told))
    buffer = _Buffer(document)
    document.nodes = _build_nodes(motion)
    tops = [0]
    if bones is None:
        tops.append(_add_body(motion, document, buffer))
    else:
        document.nodes[0].translation = root_at_rest
        document.extensionsUsed = [vrm.ANIMATION]
        humanoid = {"humanBones": {bone: {"node": node} for bone, node in bones.items()}}
        document.extensions = {vrm.ANIMATION: {"specVersion": "1.0", "humanoid": humanoid}}
    document.scene, document.scenes = 0, [pygltflib.Scene(nodes=tops)]
    document.animations = [_build_animation(motion, buffer)]
    document.buffers = [pygltflib.Buffer(byteLength=len(buffer.blob))]
    document.set_binary_blob(bytes(buffer.blob))
    return b"".join(document.save_to_bytes())


def _add_body(motion: Motion, document: pygltflib.GLTF2, buffer: _Buffer) -> int:
    """Add the skinned mesh of the motion's body; return its node."""
    joints, body = motion.num_joints, build_skinned_body(motion)
    document.meshes = [_build_mesh(body, buffer)]
    inverse = np.tile(np.eye(4, dtype=np.float32), (joints, 1, 1))
    inverse[:, 3, :3] = -body.rest  # column-major: the translation is the last row here
    document.skins = [
        pygltflib.Skin(
            joints=list(range(joints)), skeleton=0, inverseBindMatrices=buffer.add(inverse.reshape(joints, 16))
        )
    ]
    document.nodes.append(pygltflib.Node(name="mannequin", mesh=0, skin=0))
    document.materials = [
        pygltflib.Material(
            name="mannequin",
            pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
                baseColorFactor=[1.0, 1.0, 1.0, 1.0], metallicFactor=0.0, roughnessFactor=0.8
            ),
        )
    ]
    return len(document.nodes) - 1


def _build_nodes(motion: Motion) -> list[pygltflib.Node]:
    """Build a node for each joint, in file order, then one for each End Site."""
    skeleton, offsets = motion.skeleton, motion.skeleton.offsets.clone()
    offsets[0] = motion.root_position[0]
    for joint, track in motion.moving_offsets.items():
        offsets[joint] = track[0]
    below = [skeleton.children(joint) for joint in range(motion.num_joints)]
    for number, name in enumerate(skeleton.end_offsets):
        below[skeleton.index(name)].append(motion.num_joints + number)
    joints = [
        pygltflib.Node(name=name, children=children, translation=offset.tolist())
        for name, children, offset in zip(skeleton.names, below, offsets, strict=True)
    ]
    ends = [pygltflib.Node(name=f"{name}_end", translation=list(at)) for name, at in skeleton.end_offsets.items()]
    return [*joints, *ends]


def _build_mesh(body: SkinnedBody, buffer: _Buffer) -> pygltflib.Mesh:
    missing = ((0, 0), (0, 4 - body.joints.shape[1]))
    carrier = np.pad(body.joints, missing).astype(np.uint16)
    weight = np.pad(body.weights, missing).astype(np.float32)
    weight /= weight.sum(axis=1, keepdims=True)
    attributes = pygltflib.Attributes(
        POSITION=buffer.add(body.vertices.astype(np.float32), pygltflib.ARRAY_BUFFER),
        NORMAL=buffer.add(body.normals.astype(np.float32), pygltflib.ARRAY_BUFFER),
        COLOR_0=buffer.add(body.linear_rgb.astype(np.float32), pygltflib.ARRAY_BUFFER),
        JOINTS_0=buffer.add(carrier, pygltflib.ARRAY_BUFFER),
        WEIGHTS_0=buffer.add(weight, pygltflib.ARRAY_BUFFER),
    )
    faces = buffer.add(body.faces.reshape(-1).astype(np.uint32), pygltflib.ELEMENT_ARRAY_BUFFER)
    return pygltflib.Mesh(
        name=body.name, primitives=[pygltflib.Primitive(attributes=attributes, indices=faces, material=0)]
    )


def _build_animation(motion: Motion, buffer: _Buffer) -> pygltflib.Animation:
    times = buffer.add((np.arange(motion.num_frames) / float(motion.fps)).astype(np.float32))
    animation = pygltflib.Animation(name="motion", channels=[], samplers=[])
    travelling = {0: motion.root_position, **motion.moving_offsets}
    quats = make_sign_continuous(motion.local_quat_xyzw)
    tracks = [(joint, "translation", values) for joint, values in travelling.items()]
    tracks += [(joint, "rotation", quats[:, joint]) for joint in range(motion.num_joints)]
    for joint, path, values in tracks:
        output = buffer.add(values.numpy().astype(np.float32))
        animation.samplers.append(pygltflib.AnimationSampler(input=times, output=output, interpolation="LINEAR"))
        target = pygltflib.AnimationChannelTarget(node=joint, path=path)
        animation.channels.append(pygltflib.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))
    return animation
