"""Detection of gaps that nobody marked: joints that leap or freeze, and bodies that freeze and then go on elsewhere."""

import torch
from jaxtyping import Bool
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.recording.inspection import inspect_recording
from mapctl.recording.masks import ALL, ROOT, Mask

_FROZEN_SECONDS = 0.1  # that nothing at all moves, by a hair, in a motion that moves


def find_gaps(motion: Motion) -> tuple[Mask, ...]:
    """Find the gaps of a motion that nobody marked; RequestError if there are none."""
    frozen = _find_frozen_frames(motion)
    masks = [Mask(ALL, start, stop) for _, start, stop in true_intervals(frozen[:, None])]
    examined = inspect_recording(motion)
    names = motion.skeleton.names
    wrong = ~examined.seen & ~frozen[:, None]
    masks += [Mask(names[joint], start, stop) for joint, start, stop in true_intervals(wrong)]
    lost = examined.spikes_root & ~frozen
    masks += [Mask(ROOT, start, stop) for _, start, stop in true_intervals(lost[:, None])]
    if not masks:
        raise RequestError(
            "no frame is frozen and none leaps: say which frames are missing (--gap A:B) or which joints"
        )
    return tuple(masks)


def _find_frozen_frames(motion: Motion) -> Bool[Tensor, " frames"]:
    """Find runs of frames that repeat the one before them to the bit; that one is the last true one."""
    values = [motion.local_quat_xyzw.flatten(1), motion.root_position, *motion.moving_offsets.values()]
    whole = torch.cat(values, dim=1)
    still = torch.zeros(len(whole), dtype=torch.bool)
    still[1:] = (whole[1:] == whole[:-1]).all(dim=1)
    shortest = max(2, round(_FROZEN_SECONDS * float(motion.fps)))
    for _, start, stop in true_intervals(still[:, None].clone()):
        # A body that does not move at the end of its recording, or all the time, is at rest.
        if stop - start < shortest or stop == len(still):
            still[start:stop] = False
    return still if float(still.double().mean()) < 0.8 else torch.zeros_like(still)
