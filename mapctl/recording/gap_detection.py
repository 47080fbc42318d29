"""Detection of gaps that no mask gives: joints that spike, are held or are zero, and bodies that freeze."""

from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.numerics.intervals import true_intervals
from mapctl.recording.inspection import inspect_recording
from mapctl.recording.masks import ALL, ROOT, Mask


def find_gaps(motion: Motion) -> tuple[Mask, ...]:
    """Find the gaps of a motion that no mask gives; RequestError if there are none."""
    examined = inspect_recording(motion)
    frozen, names = examined.frozen, motion.skeleton.names
    masks = [Mask(ALL, start, stop) for _, start, stop in true_intervals(frozen[:, None])]
    wrong = ~examined.seen & ~frozen[:, None]
    masks += [Mask(names[joint], start, stop) for joint, start, stop in true_intervals(wrong)]
    lost = ~examined.seen_root & ~frozen
    masks += [Mask(ROOT, start, stop) for _, start, stop in true_intervals(lost[:, None])]
    if not masks:
        raise RequestError(
            "no frame is frozen and none leaps: say which frames are missing (--gap A:B) or which joints"
        )
    return tuple(masks)
