"""Armatures for the tests of the add-on; this module runs in Blender."""

import math
from itertools import pairwise

import bpy
import numpy as np
from mathutils import Euler, Matrix, Vector

# Metres, Z up, facing -Y, the left hand toward +X: heads of a T-pose.
MIXAMO = {
    "Hips": (None, (0, 0, 0.98)),
    "Spine": ("Hips", (0, 0.01, 1.08)),
    "Spine1": ("Spine", (0, 0.015, 1.2)),
    "Spine2": ("Spine1", (0, 0.02, 1.33)),
    "Neck": ("Spine2", (0, 0.02, 1.5)),
    "Head": ("Neck", (0, 0, 1.6)),
    "HeadTop_End": ("Head", (0, 0, 1.8)),
}
SIDE = {
    "Shoulder": ("Spine2", (0.06, 0.02, 1.44)),
    "Arm": ("Shoulder", (0.18, 0.03, 1.43)),
    "ForeArm": ("Arm", (0.45, 0.04, 1.43)),
    "Hand": ("ForeArm", (0.7, 0.035, 1.43)),
    "HandIndex1": ("Hand", (0.8, 0.01, 1.43)),
    "UpLeg": ("Hips", (0.09, 0, 0.93)),
    "Leg": ("UpLeg", (0.09, -0.01, 0.51)),
    "Foot": ("Leg", (0.09, 0.02, 0.1)),
    "ToeBase": ("Foot", (0.09, -0.1, 0.03)),
    "Toe_End": ("ToeBase", (0.09, -0.18, 0.03)),
}


def add_mixamo(*, imported: bool = False, seed: int = 0):
    """A Mixamo-named armature whose bones have any roll and rotation mode; as imported it is in centimetres, turned and
    scaled like armatures of FBX files."""
    rows = {f"mixamorig:{name}": (p and f"mixamorig:{p}", position) for name, (p, position) in MIXAMO.items()}
    for side, sign in (("Left", 1), ("Right", -1)):
        for name, (parent, (x, y, z)) in SIDE.items():
            above = parent if parent in MIXAMO else side + parent
            rows[f"mixamorig:{side}{name}"] = (f"mixamorig:{above}", (sign * x, y, z))
    # The armature's own space: Y up in centimetres where it is imported.
    own = Matrix.Rotation(math.radians(-90), 4, "X") @ Matrix.Scale(100, 4) if imported else Matrix.Identity(4)
    armature = _add_armature(
        "mixamo", {name: (p, own @ Vector(position)) for name, (p, position) in rows.items()}, seed
    )
    if imported:
        armature.rotation_euler = Euler((math.radians(90), 0, 0))
        armature.scale = (0.01, 0.01, 0.01)
    modes = ("QUATERNION", "XYZ", "ZYX", "AXIS_ANGLE")
    for number, bone in enumerate(armature.pose.bones):
        bone.rotation_mode = modes[number % len(modes)]
    bpy.context.view_layer.update()
    return armature


def _add_armature(name: str, rows: dict, seed: int):
    rng = np.random.default_rng(seed)
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.collection.objects.link(armature)
    _activate(armature)
    bpy.ops.object.mode_set(mode="EDIT")
    for bone, (parent, head) in rows.items():
        result = armature.data.edit_bones.new(bone)
        children = [position for above, position in rows.values() if above == bone]
        result.head = head
        result.tail = children[0] if children else head + (head - rows[parent][1]) * 0.5
        result.roll = rng.uniform(-math.pi, math.pi)
        if parent is not None:
            result.parent = armature.data.edit_bones[parent]
            result.use_connect = (result.parent.tail - result.head).length < 1e-6
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def add_metarig():
    """Rigify's human metarig."""
    bpy.ops.preferences.addon_enable(module="rigify")
    bpy.ops.object.armature_human_metarig_add()
    return bpy.context.object


def add_generated():
    """Add the rig that Rigify generates from its basic human metarig, which has no fingers and no face."""
    bpy.ops.preferences.addon_enable(module="rigify")
    bpy.ops.object.armature_basic_human_metarig_add()
    meta = bpy.context.object
    bpy.ops.pose.rigify_generate()
    (rig,) = (each for each in bpy.data.objects if each.type == "ARMATURE" and each != meta)
    meta.hide_set(True)
    return rig


def add_curve(*, cyclic: bool = False, height: float = 0.0):
    """A bent Bezier curve, moved and turned, with a bevel that is not to be followed."""
    bpy.ops.curve.primitive_bezier_curve_add(radius=1.0, location=(1, -2, height), rotation=(0, 0, 0.7))
    curve = bpy.context.object
    curve.data.bevel_depth = 0.1
    curve.data.splines[0].use_cyclic_u = cyclic
    return curve


def select(*objects) -> None:
    """Select these alone; the first is active."""
    for each in bpy.context.view_layer.objects:
        each.select_set(each in objects)
    _activate(objects[0])


def _activate(armature) -> None:
    bpy.context.view_layer.objects.active = armature
    armature.select_set(True)


def add_noise(armature, degrees: float, seed: int = 0) -> None:
    """Shake every rotation of the action."""
    rng = np.random.default_rng(seed)
    for curve in curves_of(armature):
        if "rotation" in curve.data_path and "IK_FK" not in curve.data_path:
            for key in curve.keyframe_points:
                key.co[1] += rng.normal() * math.radians(degrees)
            curve.update()


def animate(armature, seed: int = 1, positions: tuple[str, ...] = ()) -> None:
    """Key every bone at three frames, and some bones' places."""
    rng = np.random.default_rng(seed)
    for frame in (1, 6, 12):
        for bone in armature.pose.bones:
            channel = {"QUATERNION": "rotation_quaternion", "AXIS_ANGLE": "rotation_axis_angle"}
            path = channel.get(bone.rotation_mode, "rotation_euler")
            setattr(bone, path, np.array(getattr(bone, path)) + rng.normal(size=len(getattr(bone, path))) * 0.4)
            bone.keyframe_insert(path, frame=frame)
            if bone.name in positions:
                bone.location = rng.normal(size=3) * 0.2 / armature.scale[0]
                bone.keyframe_insert("location", frame=frame)


def largest_step(curve) -> float:
    """The largest step from a key of a curve to the next."""
    points = list(curve.keyframe_points)
    return max((abs(b.co[1] - a.co[1]) for a, b in pairwise(points)), default=0.0)


def curves_of(armature) -> list:
    """The curves of its action, whichever way this Blender keeps them."""
    data = armature.animation_data
    if hasattr(data.action, "fcurves"):
        return list(data.action.fcurves)
    bags = [strip.channelbag(data.action_slot) for layer in data.action.layers for strip in layer.strips]
    return [curve for bag in bags for curve in bag.fcurves]


def joints_of(armature, bones: list[str], frames: range) -> np.ndarray:
    """Heads of bones in the world, metres, Y up: (frames, bones, 3)."""
    scene, found = bpy.context.scene, []
    before = scene.frame_current
    for frame in frames:
        scene.frame_set(frame)
        heads = [armature.matrix_world @ armature.pose.bones[bone].head for bone in bones]
        found.append([(x, z, -y) for x, y, z in heads])
    scene.frame_set(before)
    return np.array(found) * scene.unit_settings.scale_length
