"""Script by which Blender writes FBX: `python write_fbx.py REQUEST`, or `blender --python write_fbx.py -- REQUEST`.

REQUEST is an .npz of `mapctl.formats.fbx_out`. Blender's own Python has numpy, but not what mapctl needs.
"""

import os
import shutil
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

sys.path.append(str(Path(__file__).resolve().parents[2]))  # last, so that numpy is Blender's own

from mapctl.blender.addon.actions import Channel, add_action, name_channel, write_channel
from mapctl.blender.addon.body import Y_UP
from mapctl.blender.addon.exchange import join_signs, to_quaternions, transpose
from mapctl.blender.addon.process import AddonError

_CENTIMETRES = 100.0
_UP = np.array([0.0, 5.0, 0.0])  # a bone of a joint, centimetres; one along Y is aligned with the world
_MOST_FPS = 32767


def write(request: dict[str, np.ndarray], folder: Path) -> None:
    """Write the motion on the character's file of the request, else on an armature with its mesh; `folder` is for
    files in the meantime."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    names = request["names"].tolist()
    armature = (_import_armature if "character" in request else _build_armature)(request, names)
    numerator, denominator = request["fps"].tolist()
    scene = bpy.context.scene
    scene.name = str(request["name"])  # which the exporter takes as the name of the animation
    scene.render.fps = min(numerator, _MOST_FPS)
    scene.render.fps_base = scene.render.fps * denominator / numerator
    scene.frame_start, scene.frame_end = 0, len(request["positions"]) - 1
    _write_keys(armature, names, request["rotations"], request["positions"])
    scene.frame_set(-1)  # the pose of this frame is that of the file's nodes
    for each in bpy.data.objects:
        for modifier in each.modifiers:
            modifier.show_viewport = False  # else the mesh is posed in every frame, for nothing
    packed = any(image.packed_file for image in bpy.data.images)  # textures within the file, named by its own name
    written = Path(folder, f"{scene.name}.fbx") if packed else Path(str(request["out"]))
    bpy.ops.export_scene.fbx(
        filepath=str(written),
        add_leaf_bones=False,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
        use_custom_props=True,
        colors_type="SRGB" if "character" in request else "LINEAR",  # as they came; as Maya and Unreal take them
        path_mode="COPY" if packed else "RELATIVE",
        embed_textures=packed,
    )
    if packed:
        shutil.copyfile(written, str(request["out"]))


def _import_armature(request: dict[str, np.ndarray], names: list[str]) -> bpy.types.Object:
    """Import the character's file and return the armature with the joints, of several the one of its name; AddonError
    where it has none."""
    path, armature = str(request["character"]), str(request["armature"])
    if "fbx_import" in dir(bpy.ops.wm):  # since Blender 4.5; also of text, which the older one does not read
        bpy.ops.wm.fbx_import(filepath=path, use_anim=False)
    else:
        bpy.ops.import_scene.fbx(filepath=path, use_anim=False)
    lacking = {
        each: [name for name in names if name not in each.data.bones and name != each.name]
        for each in bpy.data.objects
        if each.type == "ARMATURE"
    }
    if not lacking:
        raise AddonError("Blender finds no armature in the character's file; write .glb or .usda")
    found = min(lacking, key=lambda each: (len(lacking[each]), each.name != armature))
    if lacking[found]:
        raise AddonError(f"Blender imports the character without its joint {lacking[found][0]!r}; write .glb or .usda")
    bpy.context.view_layer.objects.active = found
    bpy.ops.object.mode_set(mode="EDIT")
    for bone in found.data.edit_bones:
        bone.use_connect = False  # connected ones do not travel
    bpy.ops.object.mode_set(mode="OBJECT")
    return found


def _build_armature(request: dict[str, np.ndarray], names: list[str]) -> bpy.types.Object:
    """Build an armature whose bones are aligned with the world at rest, and the mesh that it carries.

    Its space is centimetres with Y up, FBX's own, so that the file's nodes are neither turned nor scaled.
    """
    armature = bpy.data.objects.new("Armature", bpy.data.armatures.new("Armature"))
    bpy.context.collection.objects.link(armature)
    matrix = np.eye(4)
    matrix[:3, :3] = Y_UP.T / _CENTIMETRES
    armature.matrix_world = Matrix(matrix.tolist())
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    rest, parents = _CENTIMETRES * request["rest"], request["parents"].tolist()
    bones = []
    for name, head, parent in zip(names, rest, parents, strict=True):
        bones.append(_add_bone(armature, name, head, bones[parent] if parent >= 0 else None))
    for name, end in zip(request["end_names"].tolist(), request["end_offsets"], strict=True):
        joint = names.index(name)
        _add_bone(armature, f"{name}_end", rest[joint] + _CENTIMETRES * end, bones[joint])
    bpy.ops.object.mode_set(mode="OBJECT")
    _build_mesh(request, names, armature)
    return armature


def _add_bone(armature: bpy.types.Object, name: str, head: np.ndarray, parent):
    bone = armature.data.edit_bones.new(name)
    if bone.name != name:
        raise AddonError(f"Blender has no bone named {name!r}; shorten the name, or write .glb or .usda")
    bone.head, bone.tail, bone.parent = head.tolist(), (head + _UP).tolist(), parent
    return bone


def _build_mesh(request: dict[str, np.ndarray], names: list[str], armature: bpy.types.Object) -> None:
    mesh = bpy.data.meshes.new(str(request["mesh"]))
    mesh.from_pydata((_CENTIMETRES * request["vertices"]).tolist(), [], request["faces"].tolist())
    mesh.shade_smooth()
    colours = mesh.color_attributes.new("Colour", "BYTE_COLOR", "POINT")
    colours.data.foreach_set("color_srgb", request["rgba"].astype(np.float32).ravel())
    white = bpy.data.materials.new("Body")
    white.use_nodes = True
    white.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    mesh.materials.append(white)
    body = bpy.data.objects.new(mesh.name, mesh)
    bpy.context.collection.objects.link(body)
    body.parent = armature
    body.modifiers.new("Armature", "ARMATURE").object = armature
    groups = [body.vertex_groups.new(name=name) for name in names]
    for vertex, (joints, weights) in enumerate(zip(request["joints"], request["weights"], strict=True)):
        for joint, weight in zip(joints.tolist(), weights.tolist(), strict=True):
            if weight > 0:
                groups[joint].add([vertex], weight, "ADD")


def _write_keys(armature: bpy.types.Object, names: list[str], rotations: np.ndarray, positions: np.ndarray) -> None:
    """Key bones, and the armature itself where it is a joint, so that joints are at these world `rotations` (frames,
    joints, 3, 3) and `positions` (frames, joints, 3), metres, Y up; in frame -1 at rest."""
    turns, points = Y_UP.T @ rotations, positions @ Y_UP
    world = np.array(armature.matrix_world)
    size = np.cbrt(np.linalg.det(world[:3, :3]))
    outer_turn, outer_point = world[None, :3, :3] / size, world[None, :3, 3]
    add_action(armature, bpy.context.scene.name)
    if armature.name in names and armature.name not in armature.data.bones:
        own = names.index(armature.name)
        outer_turn, outer_point = turns[:, own], points[:, own]
        above = np.eye(4)
        if armature.parent is not None:
            above = np.array(armature.parent.matrix_world @ armature.matrix_parent_inverse)
        factor = np.cbrt(np.linalg.det(above[:3, :3]))
        turn = above[:3, :3].T / factor
        still = armature.matrix_basis.decompose()
        moved = (outer_point - above[:3, 3]) @ turn.T / factor
        _key(armature, armature, "", turn @ outer_turn, moved, still)
    inner = transpose(outer_turn)
    turns = inner[:, None] @ turns
    points = np.einsum("fab,fjb->fja", inner, points - outer_point[:, None]) / size
    for joint, name in enumerate(names):
        if name not in armature.data.bones:
            continue
        bone = armature.data.bones[name]
        rest, parent = np.array(bone.matrix_local), bone.parent
        turn, point = np.eye(3)[None], np.zeros((1, 3))
        if parent is not None:
            above = np.array(parent.matrix_local)
            rest = np.linalg.inv(above) @ rest
            if parent.name in names:
                turn, point = turns[:, names.index(parent.name)], points[:, names.index(parent.name)]
            else:
                turn, point = above[None, :3, :3], above[None, :3, 3]
        back = transpose(turn)
        moved = np.einsum("fab,fb->fa", back, points[:, joint] - point) - rest[:3, 3]
        pose = armature.pose.bones[name]
        _key(armature, pose, name, rest[:3, :3].T @ back @ turns[:, joint], moved @ rest[:3, :3], None)


def _key(armature: bpy.types.Object, moved, bone: str, turns: np.ndarray, points: np.ndarray, still) -> None:
    """Key rotation (frames, 3, 3) and location (frames, 3) of a bone, or of the armature without one; `still` are its
    location and rotation in frame -1, None for none."""
    location, rotation = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) if still is None else still[:2]
    moved.rotation_mode = "QUATERNION"
    quaternions = np.roll(to_quaternions(turns), 1, axis=-1)
    frames, generated = range(-1, len(points)), np.zeros(len(points) + 1, bool)
    for attribute, values in (
        ("location", np.vstack([location, points])),
        ("rotation_quaternion", join_signs(np.vstack([rotation, quaternions]))),
    ):
        path = name_channel(bone, attribute) if bone else attribute
        write_channel(armature, Channel(path, bone or armature.name, values), frames, generated)


if __name__ == "__main__":
    with np.load(sys.argv[-1], allow_pickle=False) as archive:
        arrays = dict(archive)
    try:
        write(arrays, Path(sys.argv[-1]).parent)
    except (AddonError, RuntimeError) as error:  # the latter of Blender's operators
        print(" ".join(str(error).split()), file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)  # Blender may crash as it is taken down
