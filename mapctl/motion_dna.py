"""Motion DNA: representative poses of a motion, which tell a generator its style (Zhou et al. 2020, section 3.5.1 and
appendix D).
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mapctl import kinematics, retarget, rotations
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig
from mapctl.skeleton import CANONICAL

POSES = 8
"""Poses that are taken of a motion unless another number is requested."""
_APART = PRIOR_FPS // 2  # frames between two of them, in a motion that is long enough
_LEAP = 3.0  # times as far as in any other frame: from the T-pose before a take to its first frame


def of(motion: Motion, count: int = POSES, *, rig: Rig | None = None) -> Float[Tensor, "poses joints 3"]:
    """Take poses of a motion on any known rig, in no order: frames in which joints turn fastest, apart in time
    (appendix D). They are positions of canonical joints from the hips without the hips' rotation, metres.

    RequestError for less than one pose, for a motion without frames, and for an unknown rig.
    """
    if count < 1:
        raise RequestError(f"motion DNA needs at least one pose, got {count}")
    if motion.num_frames < 1:
        raise RequestError("motion DNA needs a motion with frames")
    quats = retarget.to_canonical(motion, rig)[0].resample(PRIOR_FPS).local_quat_xyzw
    if len(quats) > 2:  # a T-pose before the take, from which joints leap to the second frame, is none of its poses
        turned = _measure_turns(quats[:, 1:])
        quats = quats[1:] if float(turned[0]) > _LEAP * float(turned[1:].max()) else quats
    return of_rotations(quats, count)


def of_rotations(
    local_quat_xyzw: Float[Tensor, "frames joints 4"], count: int = POSES
) -> Float[Tensor, "poses joints 3"]:
    """Take poses of local rotations of canonical joints at PRIOR_FPS, as `of` does; the hips' own do not matter."""
    upright = local_quat_xyzw.clone()
    upright[:, 0] = upright.new_tensor([0.0, 0.0, 0.0, 1.0])
    chosen = upright[choose_frames(upright, count)]
    return kinematics.positions_from_matrices(CANONICAL, rotations.to_matrix(chosen)).float()


def choose_frames(local_quat_xyzw: Float[Tensor, "frames joints 4"], count: int) -> Int[Tensor, " chosen"]:
    """Choose up to so many frames in which joints turn fastest, as far apart as half a second where there is room."""
    frames, turned = len(local_quat_xyzw), _measure_turns(local_quat_xyzw)
    none = turned.new_zeros(1)
    speed = torch.maximum(torch.cat([turned, none]), torch.cat([none, turned]))
    apart = min(_APART, max(1, frames // count))
    chosen: list[int] = []
    for frame in speed.argsort(descending=True, stable=True).tolist():
        if len(chosen) < count and all(abs(frame - other) >= apart for other in chosen):
            chosen.append(frame)
    return torch.tensor(sorted(chosen))


def _measure_turns(local_quat_xyzw: Float[Tensor, "frames joints 4"]) -> Float[Tensor, " steps"]:
    """Measure how far joints turn from frame to frame, mean over joints, radians."""
    change = rotations.multiply(rotations.inverse(local_quat_xyzw[:-1]), local_quat_xyzw[1:])
    return rotations.to_rotation_vector(change).norm(dim=-1).mean(dim=-1)
