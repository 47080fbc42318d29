"""USD stages of motions; the only module that imports usd-core, and imported only once a file is to be written."""

# The package loads its modules at run time and declares no types.
# pyright: reportAttributeAccessIssue=false

import errno
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt

from mapctl.formats.bvh import all_translations, as_array
from mapctl.formats.skinned import SkinnedBody, build_skinned_body
from mapctl.motion import Motion
from mapctl.rotations import make_sign_continuous
from mapctl.skeleton import Skeleton

_ROOT = "/character"
_REASON = re.compile(r"rror occurred writing file: (.+?)'")


def build_stage(motion: Motion, joints: Sequence[str]) -> Usd.Stage:
    """Build a stage in memory: skeleton, animation and skinned mannequin; `joints` are the joints' paths."""
    stage, rate = Usd.Stage.CreateInMemory(), float(motion.fps)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(motion.num_frames - 1)
    top = UsdSkel.Root.Define(stage, _ROOT)
    stage.SetDefaultPrim(top.GetPrim())
    body = build_skinned_body(motion)
    skeleton = _define_skeleton(stage, motion.skeleton, joints, body.rest)
    animation = _define_animation(stage, motion, joints)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    mesh = _define_mesh(stage, body)
    UsdSkel.BindingAPI.Apply(mesh).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    _set_extent(top, motion)
    if motion.licence:
        stage.GetRootLayer().customLayerData = {"licence": motion.licence}
    return stage


def export(stage: Usd.Stage, scratch: Path) -> None:
    """Export the stage; OSError where it cannot be written: USD's own error has many lines, the reason among them."""
    try:
        written = stage.GetRootLayer().Export(str(scratch))
    except RuntimeError as error:
        found = _REASON.search(str(error))
        reason = found[1] if found else "USD cannot write there"
        number = next((number for number in (errno.ENOSPC, errno.EDQUOT) if os.strerror(number) == reason), None)
        raise OSError(number, reason) from error
    if not written:
        raise OSError("USD does not say why")


def _define_skeleton(stage: Usd.Stage, skeleton: Skeleton, joints: Sequence[str], rest: np.ndarray) -> UsdSkel.Skeleton:
    made = UsdSkel.Skeleton.Define(stage, f"{_ROOT}/skeleton")
    made.CreateJointsAttr(joints)
    made.CreateJointNamesAttr(list(skeleton.names))
    made.CreateBindTransformsAttr(Vt.Matrix4dArray.FromNumpy(_translation_matrices(rest)))
    offsets = skeleton.offsets.numpy().copy()
    offsets[0] = 0.0
    made.CreateRestTransformsAttr(Vt.Matrix4dArray.FromNumpy(_translation_matrices(offsets)))
    return made


def _translation_matrices(places: np.ndarray) -> np.ndarray:
    """Return (n, 4, 4) translation matrices; USD's vectors are rows, so the translation is the last row."""
    matrices = np.tile(np.eye(4), (len(places), 1, 1))
    matrices[:, 3, :3] = places
    return matrices


def _define_animation(stage: Usd.Stage, motion: Motion, joints: Sequence[str]) -> UsdSkel.Animation:
    made = UsdSkel.Animation.Define(stage, f"{_ROOT}/motion")
    made.CreateJointsAttr(joints)
    made.CreateScalesAttr(Vt.Vec3hArray.FromNumpy(np.ones((len(joints), 3), np.float16)))
    places = all_translations(motion).astype(np.float32)
    turns = as_array(make_sign_continuous(motion.local_quat_xyzw)).astype(np.float32)
    moved, turned = made.CreateTranslationsAttr(), made.CreateRotationsAttr()
    if not motion.moving_offsets and (places[:, 0] == places[0, 0]).all():
        moved.Set(Vt.Vec3fArray.FromNumpy(places[0]))
    else:
        for frame, values in enumerate(places):
            moved.Set(Vt.Vec3fArray.FromNumpy(values), frame)
    for frame, values in enumerate(turns):
        turned.Set(Vt.QuatfArray.FromNumpy(values), frame)  # from imaginary parts and then the real one, as ours
    return made


def _define_mesh(stage: Usd.Stage, body: SkinnedBody):
    made = UsdGeom.Mesh.Define(stage, f"{_ROOT}/{body.name}")
    made.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(body.vertices.astype(np.float32)))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(body.faces), 3, np.int32)))
    made.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(body.faces.reshape(-1).astype(np.int32)))
    made.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(body.normals.astype(np.float32)))
    made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    made.CreateExtentAttr([Gf.Vec3f(*corner.tolist()) for corner in (body.vertices.min(0), body.vertices.max(0))])
    colour = made.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colour.Set(Vt.Vec3fArray.FromNumpy(body.linear_rgb.astype(np.float32)))
    binding = UsdSkel.BindingAPI.Apply(made.GetPrim())
    width = body.joints.shape[1]
    joints, weights = body.joints.reshape(-1).astype(np.int32), body.weights.reshape(-1).astype(np.float32)
    binding.CreateJointIndicesPrimvar(False, width).Set(Vt.IntArray.FromNumpy(joints))
    binding.CreateJointWeightsPrimvar(False, width).Set(Vt.FloatArray.FromNumpy(weights))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    return made.GetPrim()


def _set_extent(top: UsdSkel.Root, motion: Motion) -> None:
    """Set the extent of the whole trajectory, an arm's length around the joints; viewers frame the character by it."""
    places = as_array(motion.joint_positions()).reshape(-1, 3)
    corners = places.min(0) - 0.3, places.max(0) + 0.3
    top.CreateExtentAttr([Gf.Vec3f(*corner.tolist()) for corner in corners])
