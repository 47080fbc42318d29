"""Files of USD characters as other programs write them, made here by usd-core from nothing."""

from collections.abc import Sequence
from os import PathLike

import numpy as np
from character_body import ENDS, PARENTS, bone_frames, build_parts, pose_places, pose_turns
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, Vt
from scipy.spatial.transform import Rotation

JOINTS = tuple(name for name in PARENTS if name not in ENDS)
"""The skeleton's joints, parents first."""
COLOURS = {"shirt": (1.0, 0.5, 0.0), "skin": (0.6, 0.35, 0.25), "trousers": (0.1, 0.15, 0.4), "shoes": (0.0, 0.0, 0.0)}
"""Colours of the materials by part, linear."""


def joint_path(name: str) -> str:
    """A joint's path in the skeleton."""
    above = PARENTS[name]
    return f"{joint_path(above)}/{name}" if above else name


def make_character_usd(
    path: str | PathLike[str],
    *,
    up: str = "Y",
    unit: float = 1.0,
    pose: str = "T",
    rest_pose: str | None = None,
    along_y: bool = True,
    placed: str = "still",
    frames: int = 0,
    rate: float = 30.0,
    step: float = 1.0,
    start: float = 0.0,
    names: Sequence[str] = ("Body",),
    blend_shape: bool = False,
    bind: bool = True,
    crate: bool = False,
    parts: Sequence[str] = ("shirt", "skin", "trousers", "shoes"),
) -> Usd.Stage:
    """Write a person, one by name, and return the stage.

    Lengths are in `unit` metres; with `up` Z the body stands along Z. `pose` is that in which the skin is bound,
    `rest_pose` the skeleton's rest pose, the same if not given, `bind` False leaves the former out. `placed` says how
    the prim above the skeleton is: still, moved (turned and scaled by 2, the body being half as large in it), or
    animated. With `frames` an animation of random turns is bound, one sample every `step` time codes from `start` on,
    `rate` of which are a second. `blend_shape` adds a morph, and moves it; `crate` a further prim that moves.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    for number, name in enumerate(names):
        inner = unit * (2.0 if placed == "moved" else 1.0)
        root = UsdSkel.Root.Define(stage, f"/World/{name}Root")
        root.CreateExtentAttr([Gf.Vec3f(-1, 0, -1) / inner, Gf.Vec3f(1, 2, 1) / inner])
        _place(root, placed, unit)
        turn = Rotation.from_euler("x", 90, degrees=True) if up == "Z" else Rotation.identity()
        skeleton = _define_skeleton(stage, f"{root.GetPath()}/{name}", (pose, rest_pose or pose), along_y, turn, inner)
        if not bind:
            skeleton.GetBindTransformsAttr().Clear()
        _define_mesh(stage, root, skeleton, pose, turn, inner, blend_shape, parts)
        if frames:
            times = start + step * np.arange(frames)
            _define_animation(stage, skeleton, times, number, inner, blend_shape)
    if crate:
        cube = UsdGeom.Cube.Define(stage, "/World/Crate")
        for time in range(5):
            cube.GetSizeAttr().Set(1.0 + time, time)
    stage.GetRootLayer().Save()
    return stage


def _place(root: UsdSkel.Root, placed: str, unit: float) -> None:
    if placed == "moved":
        root.AddTranslateOp().Set(Gf.Vec3d(3.0, 1.0, -2.0) / unit)
        root.AddRotateYOp().Set(35.0)
        root.AddScaleOp().Set(Gf.Vec3f(2.0))
    elif placed == "animated":
        moved, turned = root.AddTranslateOp(), root.AddRotateZOp()
        for time in range(0, 9, 2):
            moved.Set(Gf.Vec3d(0.1 * time, 0.0, 0.03 * time**2) / unit, time)
            turned.Set(7.0 * time, time)


def _worlds(pose: str, along_y: bool, turn: Rotation, unit: float) -> dict[str, np.ndarray]:
    turns, frames = pose_turns(pose), bone_frames(along_y=along_y, roll_deg=17.0)
    found = {}
    for name, position in pose_places(turns).items():
        found[name] = np.eye(4)
        found[name][:3, :3] = (turn * turns[name] * frames[name]).as_matrix()
        found[name][:3, 3] = turn.apply(position) / unit
    return found


def _matrices(matrices: Sequence[np.ndarray]) -> Vt.Matrix4dArray:
    return Vt.Matrix4dArray([Gf.Matrix4d(matrix.T.tolist()) for matrix in matrices])


def _define_skeleton(
    stage: Usd.Stage, path: str, poses: tuple[str, str], along_y: bool, turn: Rotation, unit: float
) -> UsdSkel.Skeleton:
    bound, rest = (_worlds(pose, along_y, turn, unit) for pose in poses)
    local = [np.linalg.inv(rest[PARENTS[name]]) @ rest[name] if PARENTS[name] else rest[name] for name in JOINTS]
    result = UsdSkel.Skeleton.Define(stage, path)
    result.CreateJointsAttr([joint_path(name) for name in JOINTS])
    result.CreateBindTransformsAttr(_matrices([bound[name] for name in JOINTS]))
    result.CreateRestTransformsAttr(_matrices(local))
    return result


def _define_mesh(
    stage: Usd.Stage,
    root: UsdSkel.Root,
    skeleton: UsdSkel.Skeleton,
    pose: str,
    turn: Rotation,
    unit: float,
    blend_shape: bool,
    only: Sequence[str],
) -> None:
    """The body in the pose in which it is bound, its parts as subsets with materials of their own."""
    parts, turns = [part for part in build_parts(1) if part.name in only], pose_turns(pose)
    rests, positions = pose_places(pose_turns("T")), pose_places(turns)
    points, faces, weights = [], [], []
    for part in parts:
        bent = np.zeros_like(part.vertices)
        table = np.zeros((len(part.vertices), len(JOINTS)))
        for name, share in part.weights.items():
            bent += share[:, None] * (turns[name].apply(part.vertices - rests[name]) + positions[name])
            table[:, JOINTS.index(name)] = share
        faces.append(part.faces + sum(map(len, points)))
        points.append(turn.apply(bent) / unit)
        weights.append(table)
    result = UsdGeom.Mesh.Define(stage, f"{root.GetPath()}/mesh")
    vertices = np.concatenate(points).astype(np.float32)
    result.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    result.CreateFaceVertexCountsAttr([3] * sum(map(len, faces)))
    result.CreateFaceVertexIndicesAttr(np.concatenate(faces).reshape(-1).tolist())
    table = np.concatenate(weights)
    order = np.argsort(-table, axis=1)[:, :4]
    binding = UsdSkel.BindingAPI.Apply(result.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 4).Set(order.reshape(-1).tolist())
    binding.CreateJointWeightsPrimvar(False, 4).Set(np.take_along_axis(table, order, 1).reshape(-1).tolist())
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    starts = np.cumsum([0, *map(len, faces)])
    for part, first, last in zip(parts, starts, starts[1:], strict=False):
        subset = UsdGeom.Subset.CreateGeomSubset(result, part.name, "face", list(range(first, last)), "materialBind")
        _bind_material(stage, f"{root.GetPath()}/{part.name}_look", subset.GetPrim(), COLOURS[part.name])
    if blend_shape:
        shape = UsdSkel.BlendShape.Define(stage, f"{result.GetPath()}/smile")
        shape.CreateOffsetsAttr([(0.0, 0.01 / unit, 0.0)])
        shape.CreatePointIndicesAttr([0])
        binding.CreateBlendShapesAttr(["smile"])
        binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])


def _bind_material(stage: Usd.Stage, path: str, prim: Usd.Prim, colour: tuple[float, float, float]) -> None:
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*colour))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def _define_animation(
    stage: Usd.Stage, skeleton: UsdSkel.Skeleton, times: np.ndarray, seed: int, unit: float, blend_shape: bool
) -> None:
    """Turns about random axes on top of the rest pose, of all joints but the toes, in another order than theirs."""
    random = np.random.default_rng(seed)
    moved = [name for name in JOINTS if "Toes" not in name][::-1]
    positions = [JOINTS.index(name) for name in moved]
    rest = [np.array(matrix).T for matrix in skeleton.GetRestTransformsAttr().Get()]
    result = UsdSkel.Animation.Define(stage, f"{skeleton.GetPath()}/wild")
    result.CreateJointsAttr([joint_path(name) for name in moved])
    result.CreateScalesAttr([(1, 1, 1)] * len(moved))
    translations, turns = result.CreateTranslationsAttr(), result.CreateRotationsAttr()
    for time in times.tolist():
        local = [rest[position] for position in positions]
        spins = Rotation.from_rotvec(random.uniform(-0.6, 0.6, (len(moved), 3)))
        quats = (Rotation.from_matrix([matrix[:3, :3] for matrix in local]) * spins).as_quat()
        offsets = np.array([matrix[:3, 3] for matrix in local])
        offsets[-1] += random.uniform(-0.3, 0.3, 3) / unit
        translations.Set(Vt.Vec3fArray.FromNumpy(offsets.astype(np.float32)), time)
        turns.Set(Vt.QuatfArray.FromNumpy(quats.astype(np.float32)), time)
    if blend_shape:
        result.CreateBlendShapesAttr(["smile"])
        for time in times.tolist():
            result.CreateBlendShapeWeightsAttr().Set([float(random.random())], time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([result.GetPath()])
