"""In Blender: the joints of a character's animation as Blender shows them, frame by frame.

python read_character.py FOLDER MAPCTL_PYTHON FILE FPS FRAMES ACTION
"""

import json
import os
import sys
from pathlib import Path

import bpy
import numpy as np

folder, _, file, fps, frames, action = sys.argv[1:7]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = int(fps)  # before: key times become frames of the scene
bpy.ops.import_scene.gltf(filepath=file)
armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
for track in armature.animation_data.nla_tracks:
    track.mute = True
armature.animation_data.action = next(one for one in bpy.data.actions if one.name.startswith(action))
positions = np.empty((int(frames), len(armature.pose.bones), 3))
meshes = [thing for thing in bpy.data.objects if thing.type == "MESH" and thing.find_armature() == armature]
lowest = np.empty(int(frames))
for frame in range(int(frames)):
    bpy.context.scene.frame_set(frame)
    for joint, bone in enumerate(armature.pose.bones):
        positions[frame, joint] = (armature.matrix_world @ bone.matrix).translation
    drawn = bpy.context.evaluated_depsgraph_get()
    heights = [
        (thing.matrix_world @ vertex.co).z for thing in meshes for vertex in thing.evaluated_get(drawn).data.vertices
    ]
    lowest[frame] = min(heights)
facts = {"joints": [bone.name for bone in armature.pose.bones], "actions": [one.name for one in bpy.data.actions]}
facts["morphs"] = [key.name for thing in meshes if thing.data.shape_keys for key in thing.data.shape_keys.key_blocks]
facts["materials"] = sorted({slot.name for thing in meshes for slot in thing.material_slots})
Path(folder, "facts.json").write_text(json.dumps(facts))
np.savez(Path(folder, "arrays.npz"), positions=positions, lowest=lowest)
sys.stdout.flush()
os._exit(0)
