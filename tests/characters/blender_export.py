"""An armature with an action, written by Blender as FBX, USD and BVH. This module runs in Blender: FOLDER SEED."""

import random
import sys
from pathlib import Path

import bpy
from mathutils import Euler, Vector

# Metres, Z up: heads of bones, each with its parent.
BONES = {
    "hips": (None, (0, 0, 0.98)),
    "spine": ("hips", (0, 0.01, 1.1)),
    "chest": ("spine", (0, 0.02, 1.3)),
    "head": ("chest", (0, 0.01, 1.55)),
    "thigh.L": ("hips", (0.09, 0, 0.93)),
    "shin.L": ("thigh.L", (0.1, -0.01, 0.5)),
    "foot.L": ("shin.L", (0.1, 0.03, 0.09)),
    "thigh.R": ("hips", (-0.09, 0, 0.93)),
    "shin.R": ("thigh.R", (-0.1, -0.01, 0.5)),
    "foot.R": ("shin.R", (-0.1, 0.03, 0.09)),
    "arm.L": ("chest", (0.18, 0.02, 1.45)),
    "forearm.L": ("arm.L", (0.45, 0.03, 1.45)),
    "hand.L": ("forearm.L", (0.7, 0.03, 1.44)),
    "arm.R": ("chest", (-0.18, 0.02, 1.45)),
    "forearm.R": ("arm.R", (-0.45, 0.03, 1.45)),
    "hand.R": ("forearm.R", (-0.7, 0.03, 1.44)),
}
FRAMES = 20


def main(folder: Path, seed: int) -> None:
    """Make the scene and write it."""
    random.seed(seed)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    armature = add_armature()
    animate(armature)
    add_body(armature)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.fps = 1, FRAMES, (24, 30, 60)[seed % 3]
    bpy.ops.export_scene.fbx(filepath=str(folder / "skin.fbx"), add_leaf_bones=seed % 2 == 0)
    bpy.ops.export_scene.gltf(filepath=str(folder / "skin.glb"), export_force_sampling=True)
    for ending in ("usda", "usdc"):
        bpy.ops.wm.usd_export(filepath=str(folder / f"skin.{ending}"), export_animation=True, export_armatures=True)
    bpy.ops.object.select_all(action="DESELECT")
    armature.select_set(True)
    bpy.context.view_layer.objects.active = armature
    axes = {} if seed % 2 else {"axis_forward": "Y", "axis_up": "Z", "global_scale": 2.5}
    bpy.ops.export_scene.fbx(filepath=str(folder / "limbs.fbx"), use_selection=True, add_leaf_bones=False, **axes)
    bpy.ops.export_anim.bvh(filepath=str(folder / "clip.bvh"), frame_start=1, frame_end=FRAMES, rotate_mode="NATIVE")


def add_armature():
    """Bones of any roll."""
    armature = bpy.data.objects.new("Hero", bpy.data.armatures.new("Hero"))
    bpy.context.collection.objects.link(armature)
    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    below = {parent: head for parent, head in reversed(BONES.values()) if parent}
    for name, (parent, head) in BONES.items():
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail = head, below.get(name, Vector(head) + Vector((0, 0, 0.1)))
        bone.roll = random.uniform(-3, 3)
        if parent:
            bone.parent = armature.data.edit_bones[parent]
    bpy.ops.object.mode_set(mode="POSE")
    return armature


def animate(armature) -> None:
    """Keys of all turns, in any mode, and of the hips' way."""
    for number, bone in enumerate(armature.pose.bones):
        bone.rotation_mode = ("QUATERNION", "XYZ", "ZYX")[number % 3]
        for frame in range(1, FRAMES + 1):
            turn = Euler([random.uniform(-0.7, 0.7) for _ in "xyz"])
            if bone.rotation_mode == "QUATERNION":
                bone.rotation_quaternion = turn.to_quaternion()
                bone.keyframe_insert("rotation_quaternion", frame=frame)
            else:
                bone.rotation_euler = turn.to_quaternion().to_euler(bone.rotation_mode)
                bone.keyframe_insert("rotation_euler", frame=frame)
    hips = armature.pose.bones["hips"]
    for frame in range(1, FRAMES + 1):
        hips.location = [random.uniform(-0.5, 0.5) for _ in "xyz"]
        hips.keyframe_insert("location", frame=frame)
    bpy.ops.object.mode_set(mode="OBJECT")


def add_body(armature) -> None:
    """A box around each bone, carried by it."""
    points, faces, owners = [], [], []
    for bone in armature.data.bones:
        middle = (bone.head_local + bone.tail_local) / 2
        base = len(points)
        points += [tuple(middle + Vector((x, y, z)) * 0.06) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces += [tuple(base + corner for corner in side) for side in sides]
        owners += [bone.name] * 8
    mesh = bpy.data.meshes.new("Body")
    mesh.from_pydata(points, [], faces)
    body = bpy.data.objects.new("Body", mesh)
    bpy.context.collection.objects.link(body)
    for name in BONES:
        body.vertex_groups.new(name=name).add([k for k, owner in enumerate(owners) if owner == name], 1.0, "ADD")
    body.parent = armature
    body.modifiers.new("Armature", "ARMATURE").object = armature


if __name__ == "__main__":
    main(Path(sys.argv[-2]), int(sys.argv[-1]))
