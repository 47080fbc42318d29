"""The simple answer for a gap whose result is more abrupt than that, than the clip and than any capture."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.features import PRIOR_FPS
from mapctl.inbetweening.missing import MissingMask, restore_observed
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals

_MOST = 130.0  # m/s^2 of a joint over 1/30 s: one frame in a thousand of mocap's has more


def take_simpler(made: Motion, simple: Motion, missing: MissingMask) -> tuple[Motion, tuple[str, ...]]:
    """Take the simple answer in gaps whose result, beside the known frames or between them, is accelerated more than
    anything in the clip, than mocap and than the simple one; also return a note of each. Both motions are equal where
    nothing is missing."""
    lost, step = missing.frames, max(1, round(float(made.fps) / PRIOR_FPS))
    if made.num_frames < 2 * step + 1 or not bool(lost.any()):
        return made, ()
    known = ~lost.unfold(0, 2 * step + 1, 1).any(dim=-1)
    bends, simple_bends = _compute_accelerations(made, step), _compute_accelerations(simple, step)
    limit, poor = max([_MOST, *bends[known].tolist()]), torch.zeros_like(lost)
    notes = []
    for _, start, stop in true_intervals(lost[:, None]):
        rows = slice(max(0, start - 2 * step), min(len(bends), stop))
        strain, other = (float(each[rows].max()) / limit for each in (bends, simple_bends))
        if strain > max(1.0, other):
            poor[start:stop] = True
            notes.append(
                f"frames {start}:{stop}: interpolation; the result was {strain:.1f} times as abrupt as any capture"
            )
    taken = MissingMask(missing.joints & poor[:, None], missing.root & poor)
    return restore_observed(simple, made, taken), tuple(notes)


def _compute_accelerations(motion: Motion, step: int) -> Float[Tensor, " bends"]:
    """Compute the largest acceleration of any joint about each frame, m/s^2, over so many frames before and after."""
    positions = motion.joint_positions()
    bends = positions[2 * step :] - 2 * positions[step:-step] + positions[: -2 * step]
    return bends.norm(dim=-1).amax(dim=-1) * (float(motion.fps) / step) ** 2
