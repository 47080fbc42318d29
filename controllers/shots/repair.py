"""Frames in which a hand or a toe jumps, made anew: now and then a walk plants a swinging foot from one frame to the
next."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from controllers.inbetweening.pipeline import fill
from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.skeleton import CANONICAL, TOES

_ENDS = list(CANONICAL.indices(("leftHand", "rightHand", *TOES)))
_JUMP_SPEED = 3.0  # m/s about the hips
_JUMP_RATIO = 1.6  # of the speed two frames earlier and later: limbs that swing fast do so for longer
_AROUND = 6  # frames before and after a jump


def repair_jumps(motion: Motion, inbetweener: Inbetweener, *, past: Motion | None = None) -> Motion:
    """Make frames around jumps anew, where that is calmer; the first and the last frame stay. `past` are the frames
    before the first, where there are any."""
    if past is not None:
        whole = repair_jumps(past.join(motion), inbetweener)
        return replace(
            motion,
            root_position=torch.cat([motion.root_position[:1], whole.root_position[past.num_frames + 1 :]]),
            local_quat_xyzw=torch.cat([motion.local_quat_xyzw[:1], whole.local_quat_xyzw[past.num_frames + 1 :]]),
        )
    jumps = find_jumps(motion)
    missing = torch.zeros(motion.num_frames, dtype=torch.bool)
    for frame in jumps.nonzero()[:, 0].tolist():
        missing[max(1, frame - _AROUND) : frame + _AROUND + 2] = True
    missing[-1] = False
    if not bool(missing.any()):
        return motion
    made = fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion
    return made if _find_peak(made) < _find_peak(motion) else motion


def _find_peak(motion: Motion) -> float:
    """Find the largest second difference of hands and toes, metres: fast limbs that were no jump are made no better."""
    return float(torch.diff(motion.joint_positions()[:, _ENDS], n=2, dim=0).norm(dim=-1).max())


def find_jumps(motion: Motion) -> Bool[Tensor, " steps"]:
    """Find the steps from one frame to the next in which a hand or a toe moves much faster than shortly before and
    after."""
    places = motion.joint_positions()
    speed = torch.diff(places[:, _ENDS] - places[:, :1], dim=0).norm(dim=-1) * PRIOR_FPS
    beside = torch.full_like(speed, torch.inf)  # at the ends nothing shows what was before, or comes after
    beside[2:-2] = torch.maximum(speed[:-4], speed[4:])
    return ((speed > _JUMP_SPEED) & (speed > _JUMP_RATIO * beside)).any(dim=1)
