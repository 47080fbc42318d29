"""SMPL, SMPL-H and SMPL-X parameters in the layout of AMASS (Mahmood et al. 2019): an .npz with rotation vectors.

Keys: `poses` (frames, 72, 156 or 165), radians, a rotation vector of each joint in its parent's frame, relative to the
T-pose; `trans` (frames, 3), metres; `mocap_framerate`; where known `betas` and `gender`. Y or Z is up: AMASS has Z,
many estimators from video have Y, and the trunk shows it.

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

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.errors import FileFormatError, RequestError
from mapctl.formats.atomic import write_bytes
from mapctl.formats.npz import read_arrays
from mapctl.formats.text import LARGEST_VALUE, one_line, read_bytes, warn_once
from mapctl.formats.units import FASTEST, SLOWEST
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
NEEDED, OPTIONAL = ("poses", "trans"), (*_RATES, "betas", "gender")
"""Keys of a file; of the three rates one is needed."""
_Z_UP = torch.tensor([-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)], dtype=torch.float64)  # Z up to Y up


@dataclass(frozen=True, eq=False)
class SmplLayout:
    """What a file has beside the motion."""

    z_up: bool = True
    """Whether Z is up in it."""
    hips: Float[Tensor, "3"] = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))
    """Hips from where `trans` puts the body, metres, Y up."""
    betas: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Shape of the body, as the model takes it."""
    gender: str = "neutral"
    """Gender of the model."""


def build_skeleton(joints: int) -> Skeleton:
    """Build the tree of SMPL (24 joints), SMPL-H (52) or SMPL-X (55) with the bones of the canonical body, in its
    T-pose."""
    rest = make_rest(CANONICAL).joint_positions()[0]
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


def make_rest(skeleton: Skeleton) -> Motion:
    """Make one frame in the T-pose."""
    still = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(1, skeleton.num_joints, 4)
    return Motion(skeleton, Fraction(30), torch.zeros(1, 3, dtype=torch.float64), still)


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


def read(path: str | PathLike[str], arrays: Mapping[str, np.ndarray]) -> Motion:
    """Build the motion of the arrays under the keys above, Y up. FileFormatError names the key that is wrong."""
    poses, trans = (np.asarray(arrays[key]) for key in ("poses", "trans"))
    frames, joints = len(np.atleast_1d(poses)), poses.shape[-1] // 3 if poses.ndim == 2 else 0
    for key, values, shape in (("poses", poses, (frames, 3 * joints)), ("trans", trans, (frames, 3))):
        if values.dtype.kind != "f" or values.shape != shape or joints not in JOINTS or not frames:
            expected = "(frames, 72), (frames, 156) or (frames, 165)" if key == "poses" else f"({frames}, 3)"
            raise FileFormatError(path, f"{key} has {values.dtype} and shape {values.shape}, expected {expected}")
        if not (np.abs(values) < LARGEST_VALUE).all():
            raise FileFormatError(path, f"{key} holds what is no number")
    fps = _read_rate(path, arrays)
    turns = torch.from_numpy(poses.astype(np.float64)).unflatten(-1, (joints, 3))
    quats, root = rotations.from_rotation_vector(turns), torch.from_numpy(trans.astype(np.float64))
    trunk = rotations.rotate(quats[:, 0], quats.new_tensor([0.0, 1.0, 0.0])).mean(dim=0)
    z_up = bool(trunk[2].abs() > trunk[1].abs())
    if z_up:
        root = rotations.rotate(_Z_UP, root)
        quats = torch.cat([rotations.multiply(_Z_UP, quats[:, :1]), quats[:, 1:]], dim=1)
    motion = Motion(build_skeleton(joints), fps, root, rotations.make_sign_continuous(quats))
    toes = [motion.skeleton.index(name) for name in ("L_Foot", "R_Foot")]
    hips = torch.zeros(3, dtype=torch.float64)
    hips[1] = TOE_REST_HEIGHT - motion.joint_positions()[:, toes, 1].amin(dim=1).median()
    warn_once(
        f"{path}: SMPL parameters have no bones and no floor: the canonical body's are taken, and the floor is put"
        " under the feet; see --smpl-model of mapctl convert"
    )
    betas = np.asarray(arrays.get("betas", ()))
    if betas.dtype.kind != "f" or not np.isfinite(betas).all():
        betas = np.zeros(0)
    layout = SmplLayout(z_up, hips, betas.astype(np.float64).ravel(), str(arrays.get("gender", "neutral")))
    return replace(motion, root_position=root + hips, source=layout)


def _read_rate(path: str | PathLike[str], arrays: Mapping[str, np.ndarray]) -> Fraction:
    found = next((arrays[key] for key in _RATES if key in arrays), None)
    if found is None:
        raise FileFormatError(path, f"lacks the frames per second, {_RATES[0]}")
    try:
        fps = Fraction(float(found)).limit_denominator(1001)
    except (TypeError, ValueError, OverflowError):
        fps = Fraction(0)
    if not SLOWEST <= fps <= FASTEST:
        raise FileFormatError(path, f"has {found!s:.40} frames per second, allowed are {SLOWEST:g} to {FASTEST:g}")
    return fps


def save(motion: Motion, path: str | PathLike[str]) -> None:
    """Write a motion on the tree of a model under the keys above, Z up unless it was read with Y up."""
    layout = motion.source if isinstance(motion.source, SmplLayout) else SmplLayout()
    root, quats = motion.root_position - layout.hips, motion.local_quat_xyzw
    if layout.z_up:
        back = rotations.inverse(_Z_UP)
        root = rotations.rotate(back, root)
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
    hips = rotations.rotate(_Z_UP, rest[0]) if layout.z_up else rest[0]  # added along the axes of the file
    return replace(
        motion,
        skeleton=replace(motion.skeleton, offsets=offsets),
        root_position=motion.root_position - layout.hips + hips,
        source=replace(layout, hips=hips),
    )
