"""SMPL, SMPL-H and SMPL-X parameters as datasets and estimators from video save them: an .npz, or a .pt of torch.

In the layout of AMASS (Mahmood et al. 2019): `poses` (frames, 72, 156 or 165), radians, a rotation vector of each joint
in its parent's frame, relative to the T-pose; `trans` (frames, 3), metres; `mocap_framerate`; where known `betas` and
`gender`. In that of the package smplx, GVHMR and others: `global_orient`, `body_pose` (21 joints, or 23 of SMPL),
`transl`, and where known `jaw_pose`, `leye_pose`, `reye_pose`, `left_hand_pose`, `right_hand_pose`. In that of WHAM:
`pose_world` and `trans_world`. Rotations may be matrices, and have axes for joints.

Y or Z is up, or Y down, as in a camera's frame: AMASS has Z, estimators of the world have Y, and the trunk shows it.

A file has no bones: they follow from `betas` by a body model, which is not ours to bring along. Without one the bones
are those of the canonical body, and what `trans` moves is taken for the hips; the height of the floor is then unknown,
and is that of the lower foot in most frames. With a model (`fit_bones`) both are known.
"""

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product
from os import PathLike
from pickle import UnpicklingError
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.atomic import write_bytes
from mapctl.formats.missing import MissingValues
from mapctl.formats.npz import read_arrays
from mapctl.formats.parts import nearest_rotations
from mapctl.formats.text import LARGEST_VALUE, one_line, read_bytes, warn_once
from mapctl.formats.units import FASTEST, SLOWEST, choose_rate
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, TOE_REST_HEIGHT, Skeleton

_BODY = {  # joint: its parent, and the canonical joint where it is
    "Pelvis": (None, "hips"),
    "L_Hip": ("Pelvis", "leftUpperLeg"),
    "R_Hip": ("Pelvis", "rightUpperLeg"),
    "Spine1": ("Pelvis", "spine"),
    "L_Knee": ("L_Hip", "leftLowerLeg"),
    "R_Knee": ("R_Hip", "rightLowerLeg"),
    "Spine2": ("Spine1", None),
    "L_Ankle": ("L_Knee", "leftFoot"),
    "R_Ankle": ("R_Knee", "rightFoot"),
    "Spine3": ("Spine2", "chest"),
    "L_Foot": ("L_Ankle", "leftToes"),
    "R_Foot": ("R_Ankle", "rightToes"),
    "Neck": ("Spine3", "neck"),
    "L_Collar": ("Spine3", "leftShoulder"),
    "R_Collar": ("Spine3", "rightShoulder"),
    "Head": ("Neck", "head"),
    "L_Shoulder": ("L_Collar", "leftUpperArm"),
    "R_Shoulder": ("R_Collar", "rightUpperArm"),
    "L_Elbow": ("L_Shoulder", "leftLowerArm"),
    "R_Elbow": ("R_Shoulder", "rightLowerArm"),
    "L_Wrist": ("L_Elbow", "leftHand"),
    "R_Wrist": ("R_Elbow", "rightHand"),
}
_KNUCKLES = {  # of the left hand from the wrist, metres; the order is the models'
    "Index": (0.09, 0.0, 0.025),
    "Middle": (0.095, 0.0, 0.0),
    "Pinky": (0.08, 0.0, -0.04),
    "Ring": (0.09, 0.0, -0.02),
    "Thumb": (0.03, -0.01, 0.03),
}
_SIDES = (("L", 1), ("R", -1))
_PHALANX = 0.027  # metres between the joints of a finger
_SAME_REST = 0.7  # cosine between bones of rest poses that count as the same
JOINTS = (24, 52, 55)
"""Numbers of joints of SMPL, SMPL-H and SMPL-X."""
_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_GLOBAL = "smpl_params_global"  # of GVHMR: Y up
_WHOLE = {"poses": "trans", "pose_world": "trans_world"}  # rotations of all joints, and their translation
_PARTS = {  # numbers of joints
    "global_orient": (1,),
    "body_pose": (21, 23),
    "jaw_pose": (1,),
    "leye_pose": (1,),
    "reye_pose": (1,),
    "left_hand_pose": (15,),
    "right_hand_pose": (15,),
}
POSES = (*_WHOLE, "global_orient")
"""Keys by which parameters are recognised."""
KEYS = (*_WHOLE, *_WHOLE.values(), *_PARTS, "transl", *_RATES, "betas", "gender")
"""Keys that are read."""
_AS_IS = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
_Z_UP = torch.tensor([-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], dtype=torch.float64)  # Z up to Y up
_Y_DOWN = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)  # Y down to Y up
_UPSIDE_DOWN = -0.5  # cosine between the trunk and Y up, in the mean, below which Y is down


@dataclass(frozen=True, eq=False)
class SmplLayout:
    """What a file has beside the motion."""

    upright: Float[Tensor, "4"] = field(default_factory=lambda: _Z_UP)
    """Rotation of its axes, xyzw, to Y up."""
    hips: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """Hips from where `trans` puts the body, metres, Y up."""
    betas: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Shape of the body, as the model takes it."""
    gender: str = "neutral"
    """Gender of the model."""


def build_skeleton(joints: int) -> Skeleton:
    """Build the tree of SMPL (24 joints), SMPL-H (52) or SMPL-X (55) with the bones of the canonical body, in its
    T-pose."""
    rest = Motion.at_rest(CANONICAL).joint_positions()[0]
    at = {name: rest[CANONICAL.index(like)] for name, (_, like) in _BODY.items() if like is not None}
    at["Spine2"] = (at["Spine1"] + at["Spine3"]) / 2
    parents = {name: parent for name, (parent, _) in _BODY.items()}
    if joints == 24:
        for side, sign in _SIDES:
            parents[f"{side}_Hand"] = f"{side}_Wrist"
            at[f"{side}_Hand"] = at[f"{side}_Wrist"] + rest.new_tensor([sign * _KNUCKLES["Middle"][0], 0.0, 0.0])
    if joints == 55:
        for name, away in (("Jaw", (0, 0.0, 0.02)), ("L_Eye", (0.03, 0.06, 0.07)), ("R_Eye", (-0.03, 0.06, 0.07))):
            parents[name], at[name] = "Head", at["Head"] + rest.new_tensor(away)
    if joints > 24:
        for (side, sign), (finger, (x, y, z)), joint in product(_SIDES, _KNUCKLES.items(), range(3)):
            name = f"{side}_{finger}{joint + 1}"
            parents[name] = f"{side}_{finger}{joint}" if joint else f"{side}_Wrist"
            at[name] = at[f"{side}_Wrist"] + rest.new_tensor([sign * (x + joint * _PHALANX), y, z])
    names = tuple(parents)
    offsets = torch.stack([at[name] - at[parents[name]] if parents[name] else 0 * at[name] for name in names])
    return Skeleton(names, tuple(names.index(parents[name]) if parents[name] else -1 for name in names), offsets)


def order_joints(motion: Motion) -> Motion | None:
    """Return a motion on the tree of one of the models, in the model's order of joints; None where it is on another
    tree, or has another rest pose."""
    if motion.num_joints not in JOINTS or motion.moving_offsets:
        return None
    tree, own = build_skeleton(motion.num_joints), motion.skeleton
    if set(own.names) != set(tree.names):
        return None
    order = [own.index(name) for name in tree.names]
    parents = [order.index(own.parents[joint]) if own.parents[joint] >= 0 else -1 for joint in order]
    offsets = own.offsets[order]
    near = torch.cosine_similarity(offsets[1 : len(_BODY)], tree.offsets[1 : len(_BODY)], dim=-1) > _SAME_REST
    if tuple(parents) != tree.parents or not bool(near.all()):
        return None
    return replace(motion, skeleton=replace(tree, offsets=offsets), local_quat_xyzw=motion.local_quat_xyzw[:, order])


def read(
    path: str | PathLike[str], *, lossy: bool = False, fps: Fraction | float | None = None
) -> tuple[Motion, MissingValues]:
    """Read the parameters of a .pt or .pth. FileFormatError where it holds other objects than tensors, or none."""
    raw = read_bytes(path)
    try:
        found = _find_parameters(torch.load(io.BytesIO(raw), map_location="cpu", weights_only=True))
    except Exception as error:  # whatever a forged file leads torch's parsers to
        objects = "is broken or holds objects, whose reading may run code"
        why = objects if isinstance(error, UnpicklingError) else f"is no sound file of torch: {one_line(error)}"
        raise FileFormatError(path, f"{why}; save the parameters as tensors, or as an .npz") from error
    if found is None:
        raise FileFormatError(path, f"holds no SMPL parameters: tensors named {' or '.join(POSES)}")
    found, up = (found[_GLOBAL], _AS_IS) if _GLOBAL in found else (found, None)
    try:
        arrays = {key: _to_array(value) for key, value in found.items() if key in KEYS}
    except (TypeError, ValueError, RuntimeError) as error:  # sparse, or lists of unequal lengths
        raise FileFormatError(path, f"holds what is no tensor of numbers: {one_line(error)}") from error
    motion = build_motion(path, arrays, fps=fps, upright=up)
    return motion, MissingValues.none(motion.num_frames, motion.num_joints)


def _find_parameters(content: object) -> Mapping[str, Any] | None:
    """Find the first mapping in a tree of them that has parameters, or GVHMR's in the world."""
    if not isinstance(content, Mapping):
        return None
    if isinstance(content.get(_GLOBAL), Mapping) or any(key in content for key in POSES):
        return content
    return next((found for value in content.values() if (found := _find_parameters(value)) is not None), None)


def _to_array(value: object) -> np.ndarray:
    if isinstance(value, Tensor):
        value = (value.double() if value.is_floating_point() else value).detach().numpy()
    return np.asarray(value)


def build_motion(
    path: str | PathLike[str],
    arrays: Mapping[str, np.ndarray],
    *,
    fps: Fraction | float | None = None,
    upright: Float[Tensor, "4"] | None = None,
) -> Motion:
    """Build the motion of the arrays under the keys above, Y up. `fps` is for files that do not state it, `upright` the
    rotation to Y up where it is known. FileFormatError names the key that is wrong."""
    quats, root = _read_pose(path, arrays)
    fps = _read_rate(path, arrays, fps)
    trunk = rotations.rotate(quats[:, 0], quats.new_tensor([0.0, 1.0, 0.0])).mean(dim=0)
    if upright is None and trunk[1] < _UPSIDE_DOWN and trunk[1].abs() > trunk[2].abs():
        upright = _Y_DOWN
        warn_once(f"{path}: Y is down, as in a camera's frame: turned upright, as if the camera were level and still")
    if upright is None:
        upright = _Z_UP if trunk[2].abs() > trunk[1].abs() else _AS_IS
    root = rotations.rotate(upright, root)
    quats = torch.cat([rotations.multiply(upright, quats[:, :1]), quats[:, 1:]], dim=1)
    motion = Motion(build_skeleton(quats.shape[1]), fps, root, rotations.make_sign_continuous(quats))
    toes = [motion.skeleton.index(name) for name in ("L_Foot", "R_Foot")]
    hips = torch.zeros(3, dtype=torch.float64)
    hips[1] = TOE_REST_HEIGHT - motion.joint_positions()[:, toes, 1].amin(dim=1).median()
    betas = np.asarray(arrays.get("betas", ()))
    if betas.dtype.kind != "f" or not np.isfinite(betas).all():
        betas = np.zeros(0)
    betas = betas.astype(np.float64)
    betas = betas.mean(axis=0) if betas.ndim == 2 and len(betas) else betas.ravel()  # one shape a frame
    layout = SmplLayout(upright, hips, betas, str(arrays.get("gender", "neutral")))
    return replace(motion, root_position=root + hips, source=layout)


def _read_pose(
    path: str | PathLike[str], arrays: Mapping[str, np.ndarray]
) -> tuple[Float[Tensor, "frames joints 4"], Float[Tensor, "frames 3"]]:
    """Return rotations of one model's joints and the translation of the body; joints of SMPL-X that are left out do not
    turn."""
    whole = next((key for key in _WHOLE if key in arrays), None)
    moved = _WHOLE[whole] if whole else "transl"
    if lacking := [key for key in (moved, *(() if whole else ("global_orient", "body_pose"))) if key not in arrays]:
        raise FileFormatError(path, f"lacks the keys {', '.join(lacking)}")
    trans = np.asarray(arrays[moved])
    frames = len(np.atleast_1d(np.asarray(arrays[whole or "global_orient"])))
    if not frames:
        raise FileFormatError(path, f"{whole or 'global_orient'} holds no frames")
    if trans.dtype.kind != "f" or trans.shape != (frames, 3):
        raise FileFormatError(path, f"{moved} has {trans.dtype} and shape {trans.shape}, expected ({frames}, 3)")
    _check_numbers(path, moved, trans)
    root = torch.from_numpy(trans.astype(np.float64))
    if whole:
        return _read_rotations(path, whole, arrays[whole], frames, JOINTS), root
    parts = {
        key: _read_rotations(path, key, arrays[key], frames, counts) for key, counts in _PARTS.items() if key in arrays
    }
    if parts["body_pose"].shape[1] == 23:
        return torch.cat([parts["global_orient"], parts["body_pose"]], dim=1), root
    still = {key: _AS_IS.expand(frames, counts[0], 4) for key, counts in _PARTS.items()}
    return torch.cat(list((still | parts).values()), dim=1), root


def _read_rotations(
    path: str | PathLike[str], key: str, given: np.ndarray, frames: int, counts: tuple[int, ...]
) -> Float[Tensor, "frames joints 4"]:
    """Read rotation vectors or matrices of one of the numbers of joints, with or without axes for joints and rows."""
    values = np.asarray(given)
    by_frame = values.ndim > 1 and (len(values) == frames or frames == 1)  # one frame may be without its axis
    size = values.size // frames if values.dtype.kind == "f" and by_frame else 0
    joints = next((count for count in counts if size in (3 * count, 9 * count)), None)
    if joints is None:
        expected = " or ".join(f"({frames}, {3 * count})" for count in counts)
        raise FileFormatError(
            path, f"{key} has {values.dtype} and shape {values.shape}, expected {expected}, or matrices of the joints"
        )
    _check_numbers(path, key, values)
    table = torch.from_numpy(values.astype(np.float64).reshape(frames, joints, -1))
    if table.shape[-1] == 3:
        return rotations.from_rotation_vector(table)
    return rotations.from_matrix(torch.from_numpy(nearest_rotations(table.unflatten(-1, (3, 3)).numpy())))


def _check_numbers(path: str | PathLike[str], key: str, values: np.ndarray) -> None:
    if not (np.abs(values) < LARGEST_VALUE).all():
        raise FileFormatError(path, f"{key} holds what is no number")


def _read_rate(path: str | PathLike[str], arrays: Mapping[str, np.ndarray], fps: Fraction | float | None) -> Fraction:
    found = next((arrays[key] for key in _RATES if key in arrays), None)
    try:
        rate = choose_rate(path, None if found is None else float(found), fps)
    except (TypeError, ValueError):
        rate = 0.0
    if not SLOWEST <= rate <= FASTEST:  # also of nan
        raise FileFormatError(path, f"has {found!s:.40} frames per second, allowed are {SLOWEST:g} to {FASTEST:g}")
    return Fraction(rate).limit_denominator(1001)


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion on the tree of a model in the layout of AMASS, Z up unless it was read with other axes."""
    layout = motion.source if isinstance(motion.source, SmplLayout) else SmplLayout()
    back = rotations.inverse(layout.upright)
    root = rotations.rotate(back, motion.root_position - layout.hips)
    quats = motion.local_quat_xyzw
    quats = torch.cat([rotations.multiply(back, quats[:, :1]), quats[:, 1:]], dim=1)
    arrays = {
        "poses": rotations.to_rotation_vector(quats).flatten(1).numpy(),
        "trans": root.numpy(),
        "mocap_framerate": np.array(float(motion.fps)),
        "betas": layout.betas,
        "gender": np.array(layout.gender),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    write_bytes(path, buffer.getvalue())


def fit_bones(motion: Motion, path: str | PathLike[str]) -> Motion:
    """Give a motion that was read from parameters the bones of a body model, an .npz of the user's own with
    `v_template`, `shapedirs` and `J_regressor`, for its `betas`; the floor is the file's then (Loper et al. 2015,
    eq. 10). RequestError for other motions, FileFormatError for what is no such model."""
    layout = motion.source
    if not isinstance(layout, SmplLayout):
        raise RequestError("a body model is for SMPL parameters; this motion has bones of its own")
    arrays = read_arrays(path, read_bytes(path), ("v_template", "shapedirs", "J_regressor"))
    vertices, shapes, regressor = (np.asarray(arrays[key]) for key in ("v_template", "shapedirs", "J_regressor"))
    try:
        betas = layout.betas[: shapes.shape[-1]]
        found = regressor @ (vertices + shapes[..., : len(betas)] @ betas)
        rest = torch.from_numpy(found.astype(np.float64).reshape(motion.num_joints, 3))
    except (TypeError, ValueError, IndexError) as error:
        raise FileFormatError(path, f"is no model of {motion.num_joints} joints: {one_line(error)}") from error
    parents = torch.tensor(motion.skeleton.parents[1:])
    offsets = torch.cat([0 * rest[:1], rest[1:] - rest[parents]])
    hips = rotations.rotate(layout.upright, rest[0])  # added along the axes of the file
    return replace(
        motion,
        skeleton=replace(motion.skeleton, offsets=offsets),
        root_position=motion.root_position - layout.hips + hips,
        source=replace(layout, hips=hips),
    )
