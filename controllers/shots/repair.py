"""Frames in which a hand or a toe jumps, made anew: now and then a walk plants a swinging foot from one frame to the
next."""

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


def repair_jumps(motion: Motion, inbetweener: Inbetweener) -> Motion:
    """Make frames around jumps anew; the first and the last frame stay."""
    jumps = find_jumps(motion)
    missing = torch.zeros(motion.num_frames, dtype=torch.bool)
    for frame in jumps.nonzero()[:, 0].tolist():
        missing[max(1, frame - _AROUND) : frame + _AROUND + 2] = True
    missing[-1] = False
    if not bool(missing.any()):
        return motion
    return fill(motion, MissingMask.of_frames(missing, motion.num_joints), inbetweener).motion


def find_jumps(motion: Motion) -> Bool[Tensor, " steps"]:
    """Find the steps from one frame to the next in which a hand or a toe moves much faster than shortly before and
    after."""
    places = motion.joint_positions()
    speed = torch.diff(places[:, _ENDS] - places[:, :1], dim=0).norm(dim=-1) * PRIOR_FPS
    beside = torch.full_like(speed, torch.inf)  # at the ends nothing shows what was before, or comes after
    beside[2:-2] = torch.maximum(speed[:-4], speed[4:])
    return ((speed > _JUMP_SPEED) & (speed > _JUMP_RATIO * beside)).any(dim=1)
