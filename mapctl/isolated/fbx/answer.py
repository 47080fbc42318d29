"""What is asked of an FBX file, and answered."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import ufbx

from mapctl.isolated.child import Array, Found, Refusal
from mapctl.isolated.fbx.armatures import Armature, find_armatures, read_bind_poses
from mapctl.isolated.fbx.mesh import read_parts
from mapctl.isolated.fbx.scene import above, open_scene, to_matrix
from mapctl.isolated.fbx.takes import read_take, time_takes
from mapctl.isolated.naming import find_name
from mapctl.isolated.parts import pack_parts


def answer(request: Mapping[str, Any], given: Mapping[str, Array]) -> Found:
    """Answer a request: `armature` and `animation` are what was chosen or None; `wanted` is `rest`, `motion` or `mesh`;
    `most_poses` is the greatest number of frames times joints."""
    path, wanted = request["path"], request["wanted"]
    scene, fault = open_scene(path, with_mesh=wanted == "mesh")
    armatures = find_armatures(scene)
    names = [armature.name for armature in armatures]
    try:
        armature = armatures[find_name(Path(path).name, names, request["armature"], "armature", several=False)]
    except LookupError as error:
        raise Refusal(error.args[0]) from None
    said, tables = _describe(scene, armature)
    said |= {"armatures": names, "mesh_fault": fault}
    if wanted == "motion":
        said["animations"] = time_takes(scene, armature)
        take = read_take(scene, armature, request["animation"], request["most_poses"])
        if take is not None:
            said |= {"animation": take.name, "rate": take.rate}
            tables |= {"local": take.local, "above": take.above}
    if wanted == "mesh":
        parts = read_parts(scene, armature, Path(path).resolve().parent)
        said["parts"] = len(parts)
        tables |= pack_parts(parts)
    return said, tables


def _describe(scene: ufbx.Scene, armature: Armature) -> Found:
    """Return names and parents of the joints, their world matrices, and those of the poses that skins are bound in."""
    worlds = np.stack([to_matrix(node.node_to_world) for node in armature.nodes])
    root = armature.nodes[0]
    outer = np.eye(4) if root.is_root else to_matrix(above(root).node_to_world)
    tables = {"worlds": worlds, "outer": outer}
    for number, bound in enumerate(read_bind_poses(scene, armature)):
        tables[f"bound_joints_{number}"] = np.array(list(bound), np.int64)
        tables[f"bound_{number}"] = np.stack(list(bound.values()))
    if armature.ends:
        tables["ends"] = np.array([to_matrix(node.node_to_parent)[:3, 3] for node in armature.ends.values()])
    said = {
        "armature": armature.name,
        "metres_per_unit": scene.settings.original_unit_meters,
        "names": armature.names,
        "parents": armature.parents,
        "end_joints": list(armature.ends),
    }
    return said, tables
