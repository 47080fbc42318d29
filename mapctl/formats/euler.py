"""Channels of rotations (degrees of any Euler order) to quaternions and back, for whole motions at once.

A joint's matrix is the product of its channels' turns in file order, so the axes here are intrinsic. Going
back, the angles are unwrapped over time and the closer of the two equivalent solutions is taken at every
frame; those of a source can be kept in the frames that are still its own.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from mapctl import rotations

_W = 3  # index of the scalar in xyzw
_GIMBAL = 1e-7
"""Below this length of a pair of quaternion parts its angle is noise; holding it costs at most 2e-7 rad."""


def to_quat_xyzw(radians: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Convert angles (..., channels) about `axes` (0, 1, 2 for X, Y, Z), one each, to unit quaternions (..., 4)."""
    if not len(axes):
        return np.tile((0.0, 0.0, 0.0, 1.0), (*radians.shape[:-1], 1))
    turns = Rotation.from_euler("".join("XYZ"[axis] for axis in axes), radians.reshape(-1, len(axes)))
    return turns.as_quat().reshape(*radians.shape[:-1], 4)


def from_quat_xyzw(quat_xyzw: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Convert quaternions (frames, joints, 4) to radians (frames, joints, channels) that are continuous over frames.

    With fewer than three axes the angles are those of the nearest rotation the axes can make.
    """
    quat = rotations.make_sign_continuous(torch.from_numpy(quat_xyzw)).numpy()
    if len(axes) == 3:
        return _three_angles(quat, axes)
    angles = _two_angles(quat, axes) if len(axes) == 2 else _one_angle(quat, axes)
    return np.unwrap(angles, axis=0)


def can_represent(quat_xyzw: np.ndarray, axes: Sequence[int], *, tolerance: float = 2e-6) -> bool:
    """Return whether rotations about `axes` can represent these (frames, joints, 4), to `tolerance` radians."""
    if len(axes) == 3:
        return True
    round_trip = to_quat_xyzw(from_quat_xyzw(quat_xyzw, axes), axes)
    nearest = np.minimum(abs(round_trip - quat_xyzw).max(-1), abs(round_trip + quat_xyzw).max(-1))
    return bool((2 * nearest <= tolerance).all())


def keep_source_angles(path: np.ndarray, source: np.ndarray, same: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Return degrees (frames, channels): the source's own in the frames that are the `same`, the path's in others.

    These continue from the source's angles before them, at the beginning to those after them, without a jump. Where
    they do not lead to the source's angles after them but a whole turn away, or to the other of two equal solutions,
    the step is there: no angles of these rotations lead from the one to the other.
    """
    done = np.where(same[:, None], source, path)
    edges = np.flatnonzero(np.diff(~same, prepend=False, append=False))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if 0 <= (at := start - 1 if start else stop) < len(path):
            done[start:stop] = nearest_equivalent(path[[at, *range(start, stop)]], source[at], axes)[1:]
    return done


def nearest_equivalent(path: np.ndarray, wanted: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Shift a path of angles (frames, channels), or its equivalent solution, by whole turns to where its first frame is
    nearest to the target angles (channels,); degrees."""
    forms = [path, _equivalent_angles(path, axes, half=180.0)] if len(axes) == 3 else [path]
    forms = [form + 360 * np.round((wanted - form[0]) / 360) for form in forms]
    away = [abs(form[0] - wanted).sum() for form in forms]
    return forms[-1] if away[-1] < away[0] - 1e-9 else forms[0]


def _one_angle(quat: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    parts = [2 * np.arctan2(quat[..., axis], quat[..., _W]) for axis in axes]
    return np.stack(parts, axis=-1) if parts else np.zeros((*quat.shape[:-1], 0))


def _two_angles(quat: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Solve two angles: (w, i) and (j, ek) are cos b/2 and sin b/2 times (cos a/2, sin a/2); e is the handedness."""
    (i, j), k = axes, 3 - sum(axes)
    q_w, q_i, q_j, q_k = quat[..., _W], quat[..., i], quat[..., j], _handedness(i, j) * quat[..., k]
    first = np.arctan2(2 * (q_w * q_i + q_j * q_k), q_w**2 + q_j**2 - q_i**2 - q_k**2)
    second = np.arctan2(2 * (q_w * q_j + q_i * q_k), q_w**2 + q_i**2 - q_j**2 - q_k**2)
    return np.stack([first, second], axis=-1)


def _three_angles(quat: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Solve three angles: half sum and half difference of the outer ones are arguments of two pairs of quaternion
    parts.

    For distinct axes i, j, k these are (w + j, i + ek) and (w - j, i - ek), of lengths |cos b/2 +- sin b/2|; for ZXZ
    and its like (w, i) and (j, ek), of lengths cos b/2 and sin b/2; e is the axes' handedness. Where a length is zero
    (gimbal lock) only the other pair counts, and the lost angle keeps its last value.
    """
    i, j, last = axes
    proper, k, sign = i == last, 3 - i - j, _handedness(i, j)
    q_w, q_i, q_j, q_k = quat[..., _W], quat[..., i], quat[..., j], sign * quat[..., k]
    real = (q_w, q_j) if proper else (q_w + q_j, q_w - q_j)
    imaginary = (q_i, q_k) if proper else (q_i + q_k, q_i - q_k)
    half_sum, sum_length = _hold_argument(imaginary[0], real[0])
    half_difference, difference_length = _hold_argument(imaginary[1], real[1])
    if proper:
        middle, turn = 2 * np.arctan2(difference_length, sum_length), 1
    else:
        middle, turn = 2 * np.arctan2(sum_length - difference_length, sum_length + difference_length), sign
    outer = half_sum + half_difference, turn * (half_sum - half_difference)
    angles = np.stack([outer[0], middle, outer[1]], axis=-1)
    return _closest_path(angles, _equivalent_angles(angles, axes, half=np.pi))


def _equivalent_angles(angles: np.ndarray, axes: Sequence[int], *, half: float) -> np.ndarray:
    """Return the other three angles (..., 3) of the same rotations, in the unit in which a half turn is `half`."""
    first, middle, last = np.moveaxis(angles, -1, 0)
    return np.stack([first + half, (0 if axes[0] == axes[2] else half) - middle, last + half], axis=-1)


def _hold_argument(imaginary: np.ndarray, real: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return argument and length of complex numbers over frames; where one vanishes its last argument holds."""
    length = np.hypot(imaginary, real)
    known = length > _GIMBAL
    frame = np.arange(len(length)).reshape(-1, *[1] * (length.ndim - 1))
    latest = np.maximum.accumulate(np.where(known, frame, 0), axis=0)
    angle = np.where(known, np.arctan2(imaginary, real), 0.0)
    return np.take_along_axis(angle, latest, axis=0), length


def _closest_path(angles: np.ndarray, twin: np.ndarray) -> np.ndarray:
    """Choose between two equivalent solutions per frame the path of least change.

    Twinning twice is no change and keeps distances, so whether to switch does not depend on which is followed.
    """
    stay = abs(rotations.wrap_angle(angles[1:] - angles[:-1])).sum(-1)
    switch = abs(rotations.wrap_angle(twin[1:] - angles[:-1])).sum(-1) < stay - 1e-9
    first = abs(rotations.wrap_angle(twin[:1])).sum(-1) < abs(rotations.wrap_angle(angles[:1])).sum(-1) - 1e-9
    on_twin = np.cumsum(np.concatenate([first, switch]), axis=0) % 2 == 1
    path = np.where(on_twin[..., None], twin, angles)
    path[0] = rotations.wrap_angle(path[0])
    return np.unwrap(path, axis=0)


def _handedness(i: int, j: int) -> int:
    """Return 1 if the third axis is i x j, else -1."""
    return 1 if (j - i) % 3 == 1 else -1
