"""What is asked of a USD file, and answered."""

# The package loads its modules at run time and declares no types.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Tf, Usd, UsdGeom

from mapctl.isolated.child import Array, Found, Refusal
from mapctl.isolated.parts import pack_parts
from mapctl.isolated.usd.animations import read_animation, time_animations
from mapctl.isolated.usd.layers import first_reason, open_stage
from mapctl.isolated.usd.mesh import read_parts
from mapctl.isolated.usd.output import write_character
from mapctl.isolated.usd.skeletons import SkeletonPrim, choose_skeleton, find_skeletons, stage_to_world, world_of


def answer(request: Mapping[str, Any], given: Mapping[str, Array]) -> Found:
    """Answer a request: `armature` and `animation` are what was chosen or None; `wanted` is `rest`, `motion`, `mesh` or
    `write`; `most_poses` is the greatest number of frames times joints, `most_bytes` the greatest size of a layer."""
    try:
        return _answer(request, given)
    except (Tf.ErrorException, UnicodeDecodeError) as error:
        raise Refusal(f"is no sound USD file: {first_reason(error)}") from None


def _answer(request: Mapping[str, Any], given: Mapping[str, Array]) -> Found:
    path, wanted = request["path"], request["wanted"]
    stage = open_stage(path, request["most_bytes"])
    if wanted == "write":
        return dict(write_character(stage, request, given)), {}
    name, skeleton = choose_skeleton(stage, Path(path).name, request["armature"])
    said, tables = _describe(stage, name, skeleton)
    if wanted == "motion":
        said["animations"] = time_animations(stage, skeleton)
        found = read_animation(stage, skeleton, request["animation"], request["most_poses"])
        if found is not None:
            said |= {"animation": found.name, "per_second": stage.GetTimeCodesPerSecond()}
            tables |= {"seconds": found.seconds, "local": found.local, "outers": found.outer}
    if wanted == "mesh":
        parts = read_parts(stage, skeleton, Path(path).resolve().parent)
        said["parts"] = len(parts)
        tables |= pack_parts(parts)
    return said, tables


def _describe(stage: Usd.Stage, name: str, skeleton: SkeletonPrim) -> Found:
    tables = {"outer": world_of(skeleton.prim, Usd.TimeCode.EarliestTime()), "stage": stage_to_world(stage)}
    for kind, table in (("bind", skeleton.bind), ("rest", skeleton.rest)):
        if table is not None:
            tables[kind] = np.ascontiguousarray(table)
    said = {
        "armature": name,
        "metres_per_unit": UsdGeom.GetStageMetersPerUnit(stage),
        "armatures": find_skeletons(stage)[0],
        "path": str(skeleton.prim.GetPath()),
        "joints": skeleton.joints,
        "names": skeleton.names,
        "parents": skeleton.parents,
    }
    return said, tables
