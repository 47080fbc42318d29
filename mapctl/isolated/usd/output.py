"""A user's own USD character, written with an animation added; all else of its file stays as it is."""

# pyright: reportAttributeAccessIssue=false

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdGeom, UsdSkel, UsdUtils, Vt

from mapctl.isolated.child import Array, Refusal
from mapctl.isolated.usd.animations import animated_placement, name_animations, to_quaternions
from mapctl.isolated.usd.layers import first_reason, is_inside
from mapctl.isolated.usd.skeletons import SkeletonPrim, read_skeleton, read_value, walk, world_of

_MARGIN = 0.3
"""Metres around the joints within which the body is."""


def write_character(stage: Usd.Stage, request: Mapping[str, Any], given: Mapping[str, Array]) -> dict[str, str]:
    """Write the stage with the motion; return `unwritten` with the reason where that cannot be.

    `request` has the `scratch` file to write, the `folder_out` that it is for, the `skeleton`'s prim, the name of the
    `animation` that the motion was read from or None, the `stem` to name a new one by, and the frame rate `rate`.
    `given` has translations (frames, joints, 3), rotations (frames, joints, 4) xyzw, scales (joints, 3), of the
    skeleton's joints in the file's order, places (frames, joints, 3) in the world, and `outer`, (4, 4) as it was read.
    """
    scratch, folder = request["scratch"], Path(request["folder_out"]).resolve()
    try:
        _copy_stage(stage, scratch, folder)
        made = Usd.Stage.Open(scratch)
        _add_motion(made, request, given)
        if not made.GetRootLayer().Save():
            return {"unwritten": "USD does not say why"}
    except (Tf.ErrorException, RuntimeError) as error:
        return {"unwritten": first_reason(error)}
    return {}


def _copy_stage(stage: Usd.Stage, scratch: str, folder: Path) -> None:
    """Copy the file's root layer; of a package, and where other layers are not in the new file's folder, all of them in
    one, as USD composes them."""
    root = stage.GetRootLayer()
    used = [layer.realPath for layer in stage.GetUsedLayers() if layer.realPath and layer != root]
    packed = root.realPath.lower().endswith(".usdz")
    apart = packed or any(not is_inside(name, folder) for name in used)
    copied = stage.Flatten(False) if apart else Sdf.Layer.CreateAnonymous(".usda")
    if not apart:
        copied.TransferContent(root)
    if apart or Path(root.realPath).resolve().parent != folder:
        UsdUtils.ModifyAssetPaths(copied, lambda name: _move_path(name, root, folder))
    copied.Export(scratch)


def _move_path(name: str, root: Sdf.Layer, folder: Path) -> str:
    """Return how a file in another folder names what this one names."""
    full = root.ComputeAbsolutePath(name) if name else ""
    outer, inner = Ar.SplitPackageRelativePathOuter(full)
    if not full or not Path(outer).is_file():
        return name
    moved = Path(os.path.relpath(Path(outer).resolve(), folder)).as_posix()
    moved = moved if moved.startswith("..") else f"./{moved}"
    return Ar.JoinPackageRelativePath([moved, inner]) if inner else moved


def _add_motion(stage: Usd.Stage, request: Mapping[str, Any], given: Mapping[str, Array]) -> None:
    prim = stage.GetPrimAtPath(request["skeleton"])
    if not prim or not prim.IsA(UsdSkel.Skeleton):
        raise Refusal(f"has no Skeleton {request['skeleton']}")
    skeleton = read_skeleton(_as_own(stage, prim))
    replaced = _find_replaced(stage, skeleton, request["animation"])
    codes = _set_times(stage, replaced, len(given["translations"]), request["rate"])
    moved, turned, scales = _place_roots(skeleton, given, codes)
    path = skeleton.prim.GetPath().AppendChild(_free_name(skeleton.prim, request["stem"]))
    made = UsdSkel.Animation.Define(stage, path) if replaced is None else UsdSkel.Animation(_as_own(stage, replaced))
    made.CreateJointsAttr(skeleton.joints)
    _write_values(made, moved, turned, scales, codes)
    binding = UsdSkel.BindingAPI.Apply(skeleton.prim)
    binding.CreateAnimationSourceRel().SetTargets([made.GetPath()])
    _set_extent(skeleton.prim, given["places"])


def _as_own(stage: Usd.Stage, prim: Usd.Prim) -> Usd.Prim:
    """Return a prim that can be changed: what it shares with other instances is made its own."""
    path = prim.GetPath()
    for above in path.GetPrefixes():
        one = stage.GetPrimAtPath(above)
        if one.IsInstance():
            one.SetInstanceable(False)
    return stage.GetPrimAtPath(path)


def _find_replaced(stage: Usd.Stage, skeleton: SkeletonPrim, name: str | None) -> Usd.Prim | None:
    """Return the animation that the motion was read from; None where it was read from none."""
    if name is None:
        return None
    names, prims, _ = name_animations(stage, skeleton)
    return prims[names.index(name)] if name in names else None


def _set_times(stage: Usd.Stage, replaced: Usd.Prim | None, frames: int, rate: float) -> Array:
    """Set the stage's first and last time, and return the time code of every frame.

    There is one time code a frame from 0, and their rate is the motion's, unless something else in the stage moves:
    then the stage keeps its rate, so that this goes on as fast as before.
    """
    start, step = 0.0, 1.0
    if _others_move(stage, replaced):
        start = stage.GetStartTimeCode() if stage.HasAuthoredTimeCodeRange() else 0.0
        step = stage.GetTimeCodesPerSecond() / rate
    else:
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
    codes = start + np.arange(frames) * step
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    return codes


def _others_move(stage: Usd.Stage, replaced: Usd.Prim | None) -> bool:
    return any(
        attribute.ValueMightBeTimeVarying()
        for prim in walk(stage)
        if replaced is None or prim.GetPath() != replaced.GetPath()
        for attribute in prim.GetAttributes()
    )


def _place_roots(skeleton: SkeletonPrim, given: Mapping[str, Array], codes: Array) -> tuple[Array, Array, Array]:
    """Return translations (frames, joints, 3), rotations (frames, joints, 4) and scales (joints, 3), with those of the
    roots in the skeleton's space as its placement is at each time."""
    moved, turned, scales = given["translations"].copy(), given["rotations"].copy(), given["scales"].copy()
    if not animated_placement(skeleton.prim):
        return moved, turned, scales
    roots = [joint for joint, parent in enumerate(skeleton.parents) if parent < 0]
    for frame, code in enumerate(codes.tolist()):
        change = np.linalg.pinv(world_of(skeleton.prim, Usd.TimeCode(code))) @ given["outer"]
        turn = change[:3, :3] / np.cbrt(abs(np.linalg.det(change[:3, :3])))
        moved[frame, roots] = moved[frame, roots] @ change[:3, :3].T + change[:3, 3]
        turned[frame, roots] = multiply_quaternions(to_quaternions(turn[None])[0], turned[frame, roots])
    for frame in range(1, len(codes)):
        flipped = (turned[frame] * turned[frame - 1]).sum(-1) < 0
        turned[frame, flipped] *= -1
    return moved, turned, scales


def multiply_quaternions(first: Array, second: Array) -> Array:
    """Return products xyzw (n, 4) of one quaternion (4,) and several (n, 4): those' rotations, then the first's."""
    x, w = first[:3], first[3]
    y, v = second[:, :3], second[:, 3:]
    return np.concatenate([w * y + v * x + np.cross(x, y), w * v - (y @ x)[:, None]], axis=1)


def _free_name(prim: Usd.Prim, stem: str) -> str:
    plain = re.sub(r"\W", "_", stem, flags=re.ASCII) or "motion"
    plain = f"_{plain}" if plain[0].isdigit() else plain
    taken = {child.GetName() for child in prim.GetAllChildren()}
    names = [plain, *(f"{plain}_{number}" for number in range(2, len(taken) + 3))]
    return next(name for name in names if name not in taken)


def _write_values(made: UsdSkel.Animation, moved: Array, turned: Array, scales: Array, codes: Array) -> None:
    attributes = made.CreateTranslationsAttr(), made.CreateRotationsAttr(), made.CreateScalesAttr()
    for attribute in attributes:
        attribute.Clear()
    attributes[2].Set(Vt.Vec3hArray.FromNumpy(np.ascontiguousarray(scales, np.float16)))
    moved, turned = np.ascontiguousarray(moved, np.float32), np.ascontiguousarray(turned, np.float32)
    times = codes.tolist()
    for frame, code in enumerate(times):
        attributes[1].Set(Vt.QuatfArray.FromNumpy(turned[frame]), code)
        attributes[0].Set(Vt.Vec3fArray.FromNumpy(moved[frame]), code)


def _set_extent(prim: Usd.Prim, places: Array) -> None:
    """Set the extent of the SkelRoot that a skeleton is in, if it says one; viewers draw nothing beyond it."""
    while prim and not prim.IsA(UsdSkel.Root):
        prim = prim.GetParent()
    extent = UsdGeom.Boundable(prim).GetExtentAttr() if prim else None
    if not extent or read_value(extent) is None:
        return
    corners = np.array([places.min(axis=(0, 1)) - _MARGIN, places.max(axis=(0, 1)) + _MARGIN])
    grid = np.array(np.meshgrid(*corners.T)).reshape(3, -1)
    back = np.linalg.pinv(world_of(prim, Usd.TimeCode.EarliestTime()))
    own = (back[:3, :3] @ grid + back[:3, 3:]).T
    extent.Clear()
    extent.Set(Vt.Vec3fArray.FromNumpy(np.array([own.min(0), own.max(0)], np.float32)))
