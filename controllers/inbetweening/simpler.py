"""The simple answer for a gap whose result leaves the evidence beside it more abruptly than that and than the clip."""

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl.inbetweening.missing import MissingMask, restore_observed
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals

_CALM, _MOST = 1.2, 130.0
"""Accelerations, m/s^2: usual in any motion, and what one frame in a thousand of mocap exceeds. Beside known frames the
first is no fault, between them the second; nor is what the clip's known frames show."""


def take_simpler(made: Motion, simple: Motion, missing: MissingMask) -> tuple[Motion, tuple[str, ...]]:
    """Take the simple answer in gaps whose result has accelerations beyond the clip's own, and beyond the simple one's;
    also return a note of each. Both motions are equal where nothing is missing; a clip without three known frames in a
    row has none to compare with."""
    lost = missing.frames
    known = ~(lost[:-2] | lost[1:-1] | lost[2:])
    if not bool(lost.any()) or not bool(known.any()):
        return made, ()
    bends, simple_bends = _compute_accelerations(made), _compute_accelerations(simple)
    own, poor = float(bends[known].max()), torch.zeros_like(lost)
    notes = []
    for _, start, stop in true_intervals(lost[:, None]):
        rows = torch.arange(max(0, start - 2), min(len(bends), stop))
        limit = torch.where((rows < start) | (rows + 2 >= stop), max(own, _CALM), max(own, _MOST))
        strain, other = float((bends[rows] / limit).max()), float((simple_bends[rows] / limit).max())
        if strain > max(1.0, other):
            poor[start:stop] = True
            notes.append(
                f"frames {start}:{stop}: interpolation; the result was {strain:.1f} times as abrupt as the clip"
            )
    taken = MissingMask(missing.joints & poor[:, None], missing.root & poor)
    return restore_observed(simple, made, taken), tuple(notes)


def _compute_accelerations(motion: Motion) -> Float[Tensor, " bends"]:
    """Compute the largest acceleration of any joint about each frame, m/s^2."""
    return torch.diff(motion.joint_positions(), n=2, dim=0).norm(dim=-1).amax(dim=-1) * float(motion.fps) ** 2
