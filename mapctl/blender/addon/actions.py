"""Actions and their curves, before Blender 4.4 and since, where a slot of an action has them in layers."""

from collections.abc import Iterable
from dataclasses import dataclass

import bpy
import numpy as np

from .process import AddonError

_CHANNELS = ("location", "rotation_quaternion", "rotation_euler", "rotation_axis_angle", "scale")


@dataclass(frozen=True, eq=False)
class Channel:
    """Values of a property in every frame."""

    path: str
    """Data path of the property."""
    group: str
    """Group in which the curve is listed: the bone's name."""
    values: np.ndarray
    """Values, (frames, numbers of the property)."""


def name_channel(bone: str, attribute: str) -> str:
    """Name the data path of a pose bone's property."""
    return f'pose.bones["{bpy.utils.escape_identifier(bone)}"].{attribute}'


def find_action(armature: bpy.types.Object) -> bpy.types.Action:
    """Find the action that the armature plays; AddonError where there is none."""
    data = armature.animation_data
    if data is None or data.action is None:
        raise AddonError(f"{armature.name} has no action: choose one in the Action Editor")
    return data.action


def assign_action(armature: bpy.types.Object, action: bpy.types.Action | None, slot: str = "") -> None:
    """Let the armature play an action, by the slot of an identifier where actions have slots."""
    data = armature.animation_data or armature.animation_data_create()
    data.action = action
    if action is not None and slot and hasattr(data, "action_slot"):
        data.action_slot = action.slots[slot]


def name_slot(armature: bpy.types.Object) -> str:
    """Name the slot by which the armature plays its action; nothing where actions have none."""
    slot = getattr(armature.animation_data, "action_slot", None)
    return slot.identifier if slot else ""


def add_action(armature: bpy.types.Object, name: str) -> bpy.types.Action:
    """Add an empty action and let the armature play it."""
    action = bpy.data.actions.new(name)
    slot = action.slots.new(id_type="OBJECT", name=armature.name).identifier if hasattr(action, "slots") else ""
    assign_action(armature, action, slot)
    return action


def copy_action(armature: bpy.types.Object, name: str) -> bpy.types.Action:
    """Copy the action that the armature plays, and let it play the copy."""
    action, slot = find_action(armature).copy(), name_slot(armature)
    action.name = name
    assign_action(armature, action, slot)
    return action


def open_curves(armature: bpy.types.Object):
    """Open what holds the curves and groups by which an action moves the armature: the action itself, or since 4.4 the
    bag of its slot, which is created where there is none."""
    action = find_action(armature)
    if not hasattr(action, "layers"):
        return action
    layer = action.layers[0] if action.layers else action.layers.new("Layer")
    strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
    return strip.channelbag(_find_slot(armature), ensure=True)


def _find_slot(armature: bpy.types.Object):
    slot = armature.animation_data.action_slot
    if slot is None:
        raise AddonError(
            f"{find_action(armature).name} has no slot for {armature.name}: choose one in the Action Editor"
        )
    return slot


def list_keys(armature: bpy.types.Object) -> dict[int, bool]:
    """List the frames in which bones have keys, and whether one of them is not a generated key."""
    generated, frames = number_type(generated=True), {}
    for curve in open_curves(armature).fcurves:
        if not curve.data_path.startswith("pose.bones["):
            continue
        keys = curve.keyframe_points
        positions, kinds = np.empty(2 * len(keys), dtype=np.float32), np.empty(len(keys), dtype=np.int32)
        keys.foreach_get("co", positions)
        keys.foreach_get("type", kinds)
        for frame, kind in zip(np.rint(positions[::2]).astype(int).tolist(), kinds.tolist(), strict=True):
            frames[frame] = frames.get(frame, False) or kind != generated
    return dict(sorted(frames.items()))


def clear_bones(armature: bpy.types.Object, bones: Iterable[str]) -> None:
    """Remove the curves of the bones' positions, rotations and scales."""
    owned = {name_channel(bone, attribute) for bone in bones for attribute in _CHANNELS}
    curves = open_curves(armature).fcurves
    for curve in [curve for curve in curves if curve.data_path in owned]:
        curves.remove(curve)


def set_constant(armature: bpy.types.Object, path: str, value: float, frame: int) -> None:
    """Set a property to one value throughout."""
    curves = open_curves(armature).fcurves
    for curve in [curve for curve in curves if curve.data_path == path]:
        curves.remove(curve)
    curves.new(path).keyframe_points.insert(frame, value)


def write_channel(armature: bpy.types.Object, channel: Channel, frames: range, generated: np.ndarray) -> None:
    """Write a key for every frame, linear between them, generated ones where `generated` (frames,) is true."""
    holder = open_curves(armature)
    for index, values in enumerate(channel.values.T):
        curve = holder.fcurves.new(channel.path, index=index)
        curve.group = holder.groups.get(channel.group) or holder.groups.new(channel.group)
        curve.keyframe_points.add(len(frames))
        for name, numbers in _make_keys(np.arange(frames.start, frames.stop), values, generated).items():
            curve.keyframe_points.foreach_set(name, numbers)
        curve.update()


def number_type(*, generated: bool) -> int:
    """Return Blender's number of the type of key; before 4.4 jitter stands for generated keys."""
    items = bpy.types.Keyframe.bl_rna.properties["type"].enum_items
    name = ("GENERATED" if "GENERATED" in items else "JITTER") if generated else "KEYFRAME"
    return items[name].value


def _make_keys(frames: np.ndarray, values: np.ndarray, generated: np.ndarray) -> dict[str, np.ndarray]:
    """Make linear keys, as Blender's own properties of a key want them."""
    linear = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value
    kinds = np.where(generated, number_type(generated=True), number_type(generated=False))
    return {
        "co": np.stack([frames, values], axis=-1).astype(np.float32).ravel(),
        "interpolation": np.full(len(frames), linear, dtype=np.int32),
        "type": kinds.astype(np.int32),
    }
