"""Closed loops: once around a closed curve, so that the last frame leads into the first."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from controllers.inbetweening.pipeline import fill
from controllers.shots.transitions import Filling, choose_filling
from mapctl.inbetweening.missing import MissingMask
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener

OVERLAP = 54
"""Frames, at PRIOR_FPS, that a walk goes on for after once around."""
_EARLIEST, _LATEST = 16, 44  # frames after the first at which laps may be joined: about a stride
_TRIED = 3  # of the best of them
_WIDTHS = (3, 6, 10)  # frames on either side that are tried


def close_loop(motion: Motion, frames: int, inbetweener: Inbetweener) -> Motion:
    """Return one lap of so many frames of a walk that goes on for OVERLAP more: its second lap's first frames, and then
    the first lap's from where both are most alike."""
    here, later = _describe(motion, 0), _describe(motion, frames)
    count = min(len(here), len(later))
    unlike = (here[:count] - later[:count]).norm(dim=-1)
    order = unlike[_EARLIEST:_LATEST].argsort()[:_TRIED] + _EARLIEST
    tried = [_join(motion, frames, int(seam), width) for seam in order for width in _WIDTHS]
    chosen = tried[choose_filling(tried, inbetweener)]
    return fill(chosen.motion, chosen.missing, inbetweener).motion


def _describe(motion: Motion, start: int) -> Float[Tensor, "frames numbers"]:
    """Return places of joints and their steps, by frame from a first one on."""
    places = motion.joint_positions()[start:].flatten(1)
    steps = torch.diff(places, dim=0)
    return torch.cat([places[1:], 3.0 * steps], dim=-1)


def _join(motion: Motion, frames: int, seam: int, width: int) -> Filling:
    source = torch.arange(frames)
    source[:seam] += frames
    missing = torch.zeros(frames, dtype=torch.bool)
    missing[seam - width : seam + width] = True
    joined = replace(motion, root_position=motion.root_position[source], local_quat_xyzw=motion.local_quat_xyzw[source])
    mask = MissingMask.of_frames(missing, motion.num_joints)
    return Filling(joined, mask, (seam - width, seam + width))
