"""Files of skinned characters as exporters write them: glTF and VRM, made here from nothing.

`make_character_glb(path)` writes a person like one that went from Mixamo through Blender: bones along their Y axes, in
centimetres and with Z up below an armature node that makes up for it, a picture on the shirt, several materials.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from character_body import ENDS, PARENTS, PLACES, Part, bone_frames, build_parts, pose_places, pose_turns
from glb_builder import GlbBuilder, Look, split_side, without_scale
from scipy.spatial.transform import Rotation

Array = np.ndarray
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


def name_joints(names: str | Mapping[str, str]) -> dict[str, str]:
    """A file's names by those of character_body: mixamo, readyplayer (no prefix), vrm, unreal, or any by a mapping."""
    if not isinstance(names, str):
        return {joint: names.get(joint, joint) for joint in PARENTS}
    found = {}
    for joint in PARENTS:
        side, part = split_side(joint)
        if names in ("mixamo", "readyplayer"):
            found[joint] = ("mixamorig:" if names == "mixamo" else "") + side.capitalize() + _MIXAMO[part]
        elif names == "unreal":
            found[joint] = _UNREAL[part] + (f"_{side[0]}" if side else "")
        else:
            assert names in ("vrm", "vrm0"), f"no names {names!r}"
            found[joint] = f"J_Bip_{side[0].upper() if side else 'C'}_{part[0].upper() + part[1:]}"
    return found


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
    """Names of the joints, parents first."""
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
    """Parts of a body, with the file's weights, texture coordinates and triangles."""
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
    build = GlbBuilder(Path(path))
    outer = np.eye(4)
    if zup_armature:
        outer[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    outer[:3, :3] *= armature_scale
    front = Rotation.from_euler("y", 180 if names == "vrm0" else 0, degrees=True)
    own = [*(["root"] if root else []), *(j for j in PARENTS if leaves != "none" or j not in ENDS)]
    parents = {j: PARENTS.get(j, "") or ("root" if root and j != "root" else "") for j in own}
    given = name_joints(names) | ({"root": root} if root else {})
    bound = _world_frames(pose, own, front, size, bones_along_y, roll_deg)
    posed = bound if node_pose is None else _world_frames(node_pose, own, front, size, bones_along_y, roll_deg)

    top = build.node(armature, None, outer, matrix=matrices)
    for joint in own:
        above = posed[parents[joint]] if parents[joint] else outer
        below = _unscaled(outer, above) if parents[joint] else above
        local = np.linalg.inv(below) @ posed[joint]
        local[:3, :3] = Rotation.from_matrix(without_scale(local[:3, :3])).as_matrix()
        if parents[joint]:
            local[:3, 3] = above[:3, :3].T @ (posed[joint][:3, 3] - above[:3, 3]) / armature_scale
        build.node(given[joint], build.at.get(parents[joint], top), local, key=joint, matrix=matrices)

    skinned = [j for j in own if leaves == "joints" or j not in ENDS]
    space = outer if bind == "armature" else np.eye(4)
    turns, positions = pose_turns(pose), pose_places(pose_turns(pose))
    parts = [_bend(part, turns, positions, front, size) for part in build_parts(detail)]
    materials = {name: build.material(name, look, picture) for name, look in looks.items()}
    apart = "trousers" if second_skin else None
    groups = [[p for p in parts if p.name != apart], [p for p in parts if p.name == apart]][: 2 if second_skin else 1]
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
        joint={j: given[j] for j in own if j != "root"},
        names=tuple(given[j] for j in own),
        nodes=tuple(build.at[j] for j in own),
        positions=np.stack([bound[j][:3, 3] for j in own]),
        rotations=np.stack([bound[j][:3, :3] for j in own]),
        vertices=np.concatenate([part.vertices for part in order]),
        faces=np.concatenate([part.faces + start for part, start in zip(order, shift, strict=False)]),
        parts=tuple(order),
        size=size,
        animations=tuple(animations),
    )


def _world_frames(
    pose: str, own: Sequence[str], front: Rotation, size: float, along_y: bool, roll_deg: float
) -> dict[str, Array]:
    """World matrices of the joints' frames in a pose, without scale."""
    turns, frames = pose_turns(pose), bone_frames(along_y=along_y, roll_deg=roll_deg)
    positions = pose_places(turns)
    found = {"root": np.eye(4)}
    found["root"][:3, :3] = front.as_matrix()
    for joint in own:
        if joint != "root":
            matrix = np.eye(4)
            matrix[:3, :3] = (front * turns[joint] * frames[joint]).as_matrix()
            matrix[:3, 3] = size * front.apply(positions[joint])
            found[joint] = matrix
    return found


def _unscaled(outer: Array, above: Array) -> Array:
    return _scaled(above, float(np.cbrt(np.linalg.det(outer[:3, :3]))))


def _scaled(matrix: Array, scale: float) -> Array:
    found = matrix.copy()
    found[:3, :3] *= scale
    return found


def _bend(
    part: Part, turns: Mapping[str, Rotation], positions: Mapping[str, Array], front: Rotation, size: float
) -> Part:
    """The part in the pose in which it is bound, by its own weights."""
    vertices, normals = np.zeros_like(part.vertices), np.zeros_like(part.normals)
    for joint, share in part.weights.items():
        vertices += share[:, None] * (turns[joint].apply(part.vertices - PLACES[joint]) + positions[joint])
        normals += share[:, None] * turns[joint].apply(part.normals)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Part(part.name, size * front.apply(vertices), front.apply(normals), part.faces, part.uv, part.weights)


def _add_hat(build: GlbBuilder, material: int, size: float, armature_scale: float) -> None:
    """A box on the head: a mesh that no skin carries, in metres below a node that makes up for the armature's scale."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * size * 0.1
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = quads[:, [0, 1, 2, 0, 2, 3]]
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


def _declare_humanoid(build: GlbBuilder, names: str) -> None:
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
