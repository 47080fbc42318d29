"""Rigs that Rigify made: which controls make its joints, and Rigify's names of them for mapctl.

The FK controls of a generated rig move as the joints do. The torso carries the second spine joint, the lower spine
bends from there to the hips and the upper spine to the chest.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np

from .body import Body, Control, measure_frame
from .process import AddonError

_SIDES = {"L": "left", "R": "right"}
_TRUNK = (
    # joint, bone that moves with it, parent, control
    ("spine", "spine_fk", None, "spine_fk"),
    ("spine.001", "spine_fk.001", "spine", "torso"),
    ("spine.002", "spine_fk.002", "spine.001", "spine_fk.002"),
    ("spine.003", "spine_fk.003", "spine.002", "spine_fk.003"),
    ("spine.004", "neck", "spine.003", "neck"),
    ("HEAD", "head", "spine.004", "head"),
)
_LIMBS = (
    ("shoulder", "shoulder", "spine.003"),
    ("upper_arm", "upper_arm_fk", "shoulder"),
    ("forearm", "forearm_fk", "upper_arm"),
    ("hand", "hand_fk", "forearm"),
    ("thigh", "thigh_fk", "spine"),
    ("shin", "shin_fk", "thigh"),
    ("foot", "foot_fk", "shin"),
    ("toe", "toe_fk", "foot"),
)
_CANONICAL = {
    "hips": "spine",
    "spine": "spine.001",
    "chest": "spine.003",
    "neck": "spine.004",
    "Shoulder": "shoulder",
    "UpperArm": "upper_arm",
    "LowerArm": "forearm",
    "Hand": "hand",
    "UpperLeg": "thigh",
    "LowerLeg": "shin",
    "Foot": "foot",
    "Toes": "toe",
}
"""Joints of the metarig by mapctl's name; those in capitals are there on both sides."""
_HEADS = ("spine.006", "spine.005")  # of the human metarig, and of the basic one
_SWITCH = "IK_FK"  # 0 is IK, 1 is FK


def is_generated(armature: bpy.types.Object) -> bool:
    """Return whether Rigify made the armature from a metarig of a human."""
    bones = armature.data.bones
    return any(bone.name.startswith("ORG-") for bone in bones) and any(bone.name.startswith("DEF-") for bone in bones)


def describe_names(names: tuple[str, ...], prefix: str = "") -> str:
    """Describe Rigify's names in a rig file for mapctl; nothing where one of a body's joints is missing."""
    joints = dict(_iterate_names(prefix, next((name for name in _HEADS if prefix + name in names), "")))
    if not set(joints.values()) <= set(names):
        return ""
    return "\n".join(['name = "rigify"', "[joints]", *(f'{key} = "{own}"' for key, own in joints.items())]) + "\n"


def _iterate_names(prefix: str, head: str) -> Iterator[tuple[str, str]]:
    for canonical, own in {**_CANONICAL, "head": head}.items():
        if canonical[0].islower():
            yield canonical, prefix + own
            continue
        for letter, side in _SIDES.items():
            yield side + canonical, f"{prefix}{own}.{letter}"


def take_controls(armature: bpy.types.Object, scene: bpy.types.Scene) -> Body:
    """Take the joints of a generated rig, and the controls that make them; AddonError where some are missing."""
    bones = armature.data.bones
    rows = list(_list_rows(bones))
    names = [f"DEF-{joint}" for joint, *_ in rows]
    missing = [name for joint, shown, _, control in rows for name in (f"DEF-{joint}", shown, control)]
    missing = [name for name in missing if name not in bones]
    if missing:
        raise AddonError(
            f"{armature.name}: only rigs of Rigify's human metarigs are known, and {missing[0]} is missing"
        )
    number = {joint: index for index, (joint, *_) in enumerate(rows)}
    shown = [row[1] for row in rows]
    return Body(
        names=tuple(names),
        bones=tuple(shown),
        parents=tuple(-1 if parent is None else number[parent] for _, _, parent, _ in rows),
        heads=np.array([bones[name].head_local for name in names], dtype=np.float64),
        rests=np.array([bones[name].matrix_local for name in shown], dtype=np.float64),
        ends={name: np.array(bones[name].tail_local, dtype=np.float64) for name in names if _is_last(name)},
        frame=measure_frame(armature, scene),
        controls=tuple(_list_controls(rows, number)),
        switches={bone.name: _SWITCH for bone in armature.pose.bones if _SWITCH in bone},
        rig_toml=describe_names(tuple(names), "DEF-"),
    )


@contextmanager
def keep_lengths(armature: bpy.types.Object) -> Iterator[None]:
    """Let limbs keep their lengths within, where inverse kinematics would stretch and squeeze them."""
    before = {bone.name: bone.ik_stretch for bone in armature.pose.bones if bone.ik_stretch > 0}
    try:
        for name in before:
            armature.pose.bones[name].ik_stretch = 0.0
        yield
    finally:
        for name, value in before.items():
            armature.pose.bones[name].ik_stretch = value


def _list_rows(bones: bpy.types.bpy_prop_collection) -> Iterator[tuple[str, str, str | None, str]]:
    """List joint, bone that moves with it, parent and control."""
    head = next((name for name in _HEADS if f"DEF-{name}" in bones), _HEADS[0])
    for joint, shown, parent, control in _TRUNK:
        yield (head if joint == "HEAD" else joint), shown, parent, control
    for letter in _SIDES:
        for joint, control, parent in _LIMBS:
            # Rigs of earlier versions have one control for the toes.
            own = "toe" if joint == "toe" and f"toe_fk.{letter}" not in bones else control
            above = parent if parent.startswith("spine") else f"{parent}.{letter}"
            yield f"{joint}.{letter}", f"ORG-{joint}.{letter}", above, f"{own}.{letter}"


def _list_controls(rows: list[tuple[str, str, str | None, str]], number: dict[str, int]) -> Iterator[Control]:
    """List the controls with the joint that carries each; the hips hang from the second spine joint."""
    torso = number["spine.001"]
    for joint, _, parent, control in rows:
        if control == "torso":
            yield Control(control, torso, None, travels=True)
        elif control in ("spine_fk", "head"):  # heads keep their rotation where the neck bends
            yield Control(control, number[joint], torso)
        else:
            yield Control(control, number[joint], None if parent is None else number[parent])


def _is_last(name: str) -> bool:
    return name.removeprefix("DEF-").startswith(("hand", "toe", *_HEADS))
