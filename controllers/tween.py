"""In-betweening: a few keys to a whole motion that meets them (keys are no unknowns, so they are met to the bit)."""

from collections.abc import Sequence
from typing import Any

import torch

from controllers.filling import Infilled, InfillSettings, fill
from mapctl.errors import RequestError
from mapctl.gaps.lost import Lost
from mapctl.motion import Motion
from mapctl.protocols import Inbetweener
from mapctl.rigs import Rig


def tween(
    motion: Motion, keys: Sequence[int], infiller: Inbetweener | None, *,
    settings: InfillSettings | None = None, densities: Sequence[Any] = (), rig: Rig | None = None,
) -> Infilled:  # fmt: skip
    """A motion of the same length that goes through the frames `keys` of a motion, of which nothing else counts.

    RequestError for keys that are not frames of it, and for fewer than two.
    """
    frames, wanted = motion.num_frames, sorted(set(keys))
    beyond = [key for key in wanted if not 0 <= key < frames]
    if beyond:
        raise RequestError(f"the key {beyond[0]} is not one of the motion's frames 0:{frames}")
    if len(wanted) < 2:
        raise RequestError(f"in-betweening needs at least two keys, got {len(wanted)}")
    free = torch.ones(frames, dtype=torch.bool)
    free[wanted] = False
    lost = Lost(free[:, None].expand(-1, motion.num_joints).clone(), free)
    return fill(motion, lost, infiller, settings=settings, densities=densities, rig=rig)
