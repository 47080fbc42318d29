"""Standard deviations of positions that L2P divides by (Harvey et al. 2020)."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.features import GroundPose, integrate_root
from mapctl.pose import BodyPose
from mapctl.skeleton import CANONICAL
from priors.training.corpus import Corpus

_WINDOW, _STRIDE, _FACING_FRAME = 50, 20, 9
_MIN_STD = 1e-4


def compute_position_std(corpus: Corpus) -> Float[Tensor, "joints 3"]:
    """Compute the standard deviation, metres, of every coordinate over windows of 50 frames every 20, centred on their
    mean hips on the ground and turned so that the hips of their tenth frame face +Z.
    """
    origin = GroundPose(torch.zeros(2), torch.zeros(()))
    (total, square), count = torch.zeros(2, CANONICAL.num_joints, 3, dtype=torch.float64), 0
    for clip in corpus.clips():
        starts = torch.tensor(range(0, len(clip) - _WINDOW + 1, _STRIDE), dtype=torch.long)
        if not len(starts):
            continue
        _, heading = integrate_root(clip, origin)
        frames = starts[:, None] + torch.arange(_WINDOW)
        positions = BodyPose.of_features(clip, origin).joints_world().double()[frames]
        centre = rotations.lift_ground(positions[:, :, 0, ::2].mean(dim=1))[:, None, None]
        facing = heading.double()[starts + _FACING_FRAME]
        seen = rotations.rotate_about_y(positions - centre, -facing[:, None, None]).flatten(0, 1)
        total, square, count = total + seen.sum(dim=0), square + seen.square().sum(dim=0), count + len(seen)
    mean = total / max(1, count)
    return (square / max(1, count) - mean.square()).clamp_min(0).sqrt().clamp_min(_MIN_STD)
