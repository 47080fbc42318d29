"""Skeletons of a USD stage: their joints, placement and poses."""

# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdSkel

from mapctl.isolated.child import Refusal
from mapctl.isolated.naming import find_name, make_unique

Array = np.ndarray
MAX_JOINTS = 4096
"""Most joints of a skeleton."""
_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True, eq=False)
class SkeletonPrim:
    """A UsdSkel.Skeleton, read."""

    prim: Usd.Prim
    """The prim."""
    joints: list[str]
    """Paths of its joints."""
    names: list[str]
    """Names of its joints, unique."""
    parents: list[int]
    """Index of each joint's parent, -1 where it has none."""
    bind: Array | None
    """(joints, 4, 4) of the pose in which skins are bound, in the skeleton's space; None where it says none."""
    rest: Array | None
    """(joints, 4, 4) of the pose of joints that nothing moves, in their parents' frames; None where it says none."""


def find_skeletons(stage: Usd.Stage) -> tuple[list[str], list[Usd.Prim]]:
    """Find the skeletons of a stage, those in instances too, with unique names. Refusal where there is none."""
    prims = [prim for prim in walk(stage) if prim.IsA(UsdSkel.Skeleton)]
    if not prims:
        raise Refusal("has no Skeleton (UsdSkel), so nothing in it says what a character's joints are")
    return make_unique([prim.GetName() for prim in prims]), prims


def choose_skeleton(stage: Usd.Stage, file: str, wanted: str | None) -> tuple[str, SkeletonPrim]:
    """Return the wanted or only skeleton and its name; Refusal names them where there are several."""
    names, prims = find_skeletons(stage)
    try:
        number = find_name(file, names, wanted, "armature", several=False)
    except LookupError as error:
        raise Refusal(error.args[0]) from None
    return names[number], read_skeleton(prims[number])


def walk(stage: Usd.Stage) -> Usd.PrimRange:
    """Go through the prims of a stage, those in instances too."""
    return Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())


def read_skeleton(prim: Usd.Prim) -> SkeletonPrim:
    """Read a skeleton's joints and poses. Refusal where they are no tree, or its tables do not fit together."""
    skeleton, where = UsdSkel.Skeleton(prim), f"skeleton {prim.GetName()!r}"
    joints = [str(joint) for joint in read_value(skeleton.GetJointsAttr()) or ()]
    if not joints:
        raise Refusal(f"{where} has no joints")
    if len(joints) > MAX_JOINTS:
        raise Refusal(f"{where} has {len(joints)} joints, allowed are {MAX_JOINTS}")
    parents = _find_parents(joints, where)
    said = [str(name) for name in read_value(skeleton.GetJointNamesAttr()) or ()]
    bind = _read_matrices(skeleton.GetBindTransformsAttr(), len(joints), where)
    rest = _read_matrices(skeleton.GetRestTransformsAttr(), len(joints), where)
    if bind is None and rest is None:
        raise Refusal(f"{where} has neither bindTransforms nor restTransforms")
    return SkeletonPrim(prim, joints, _name_joints(joints, said), parents, bind, rest)


def world_of(prim: Usd.Prim, time: Usd.TimeCode) -> Array:
    """Return what takes a prim's space to the world of Y up and metres at a time, (4, 4)."""
    stage = prim.GetStage()
    matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(prim)).T
    return stage_to_world(stage) @ matrix


def stage_to_world(stage: Usd.Stage) -> Array:
    """Return what takes the stage's up axis and unit to Y up and metres, (4, 4)."""
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    if not (np.isfinite(unit) and 1e-9 < unit < 1e9):
        raise Refusal(f"metersPerUnit is {unit:g}")
    turn = _TO_Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else np.eye(4)
    return np.diag([unit, unit, unit, 1.0]) @ turn


def read_value(attribute: Usd.Attribute, time: Usd.TimeCode | None = None):
    """Return an attribute's value at a time, else its default or earliest one; None where it has none that is known."""
    try:
        value = attribute.Get(Usd.TimeCode.EarliestTime() if time is None else time)
    except Tf.ErrorException:
        return None
    return None if isinstance(value, Sdf.UnregisteredValue) else value


def _find_parents(joints: list[str], where: str) -> list[int]:
    """Return each joint's nearest one above it in its path, which must come before it."""
    place = {joint: number for number, joint in enumerate(joints)}
    if len(place) < len(joints):
        raise Refusal(f"{where} names a joint twice")
    parents = []
    for number, joint in enumerate(joints):
        words = joint.split("/")
        above = ("/".join(words[:length]) for length in range(len(words) - 1, 0, -1))
        parent = next((place[path] for path in above if path in place), -1)
        if parent >= number:
            raise Refusal(f"{where}: joint {joint!r} comes before the joint above it")
        parents.append(parent)
    return parents


def _name_joints(joints: list[str], said: list[str]) -> list[str]:
    """Return the names that the skeleton gives its joints, else the last words of their paths where these are unique,
    else the paths."""
    if len(said) == len(joints) and len(set(said)) == len(said) and all(said):
        return said
    leaves = [joint.rpartition("/")[2] for joint in joints]
    return leaves if len(set(leaves)) == len(leaves) else joints


def _read_matrices(attribute: Usd.Attribute, count: int, where: str) -> Array | None:
    value = read_value(attribute)
    if value is None or not len(value):
        return None
    if len(value) != count:
        raise Refusal(f"{where} has {count} joints and {len(value)} {attribute.GetName()}")
    matrices = np.array(value, np.float64).reshape(count, 4, 4).transpose(0, 2, 1)
    if not np.isfinite(matrices).all():
        raise Refusal(f"{where}: {attribute.GetName()} holds numbers that are not finite")
    return matrices
