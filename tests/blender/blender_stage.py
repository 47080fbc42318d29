"""The add-on on an empty stage, for scripts that run in Blender: `python SCRIPT FOLDER PYTHON ...`."""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np

FOLDER, PYTHON = Path(sys.argv[1]), sys.argv[2]
SCRIPTS = Path(__file__).resolve().parent
ADDON = "bl_ext.user_default.mapctl"


def install() -> None:
    """Install the zip as users do, and clear the scene."""
    bpy.ops.extensions.package_install_files(
        filepath=str(FOLDER / "addon.zip"), repo="user_default", enable_on_install=True
    )
    for each in list(bpy.data.objects):
        bpy.data.objects.remove(each)


def set_command(*words: object) -> None:
    """Set the preference: the words that start mapctl."""
    bpy.context.preferences.addons[ADDON].preferences.command = " ".join(map(str, words))


def use(mode: str) -> None:
    """Let the stub answer in this mode."""
    set_command(sys.executable, SCRIPTS / "stub.py", mode, FOLDER)


def module(name: str):
    """A module of the add-on as it is installed."""
    return sys.modules[f"{ADDON}.{name}"]


def clear() -> None:
    """An empty scene."""
    for group in (bpy.data.objects, bpy.data.actions, bpy.data.curves):
        for each in list(group):
            group.remove(each)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base, scene.unit_settings.scale_length = 30, 1.0, 1.0
    scene.use_preview_range = False
    scene.frame_set(1)


def state() -> list:
    """All that an operator could have changed."""
    armature = bpy.context.object
    data = armature.animation_data
    return [
        sorted(each.name for each in bpy.data.actions),
        data.action.name if data and data.action else None,
        bpy.context.scene.frame_current,
        bpy.context.scene.frame_end,
        [[round(value, 5) for row in bone.matrix_basis for value in row] for bone in armature.pose.bones],
        [bone["IK_FK"] for bone in armature.pose.bones if "IK_FK" in bone],
        len(bpy.data.objects),
    ]


def printed() -> tuple[str, ...]:
    """Return the lines of the panel."""
    return tuple(module("interface").Report.lines)


def finish(facts: dict, arrays: dict | None = None) -> None:
    """Hand the results on, and end."""
    (FOLDER / "facts.json").write_text(json.dumps(facts))
    if arrays is not None:
        np.savez(FOLDER / "arrays.npz", **arrays)
    sys.stdout.flush()
    os._exit(0)  # bpy 4.2 crashes as it is taken down where Rigify generated a rig
