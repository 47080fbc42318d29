"""Motions made comparable: measures depend on the joints, the up axis and the frame rate."""

from mapctl import retarget
from mapctl.errors import RequestError
from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.retarget import UNKNOWN_RIG_NOTE
from mapctl.retarget.rigs import Rig

_RATE_TOLERANCE = 0.02  # share of the reference's rate within which measures are the same, as of 29.97 frames a second


def make_comparable(motion: Motion, rig: Rig | None = None) -> tuple[Motion, tuple[str, ...]]:
    """Convert a motion to what reference values of mocap were measured on: canonical joints, Y up, 30 frames a second.

    Frames are left out of faster motions; slower ones stay, since nothing is known between their frames. Sentences tell
    what could not be made so: a rig that is not known stays as it is in the file. `rig` wins over what would be
    recognised.
    """
    notes: tuple[str, ...] = ()
    try:
        motion = retarget.to_canonical(motion, rig)[0]
    except RequestError:
        notes = (UNKNOWN_RIG_NOTE,)
    if motion.fps > PRIOR_FPS * (1 + _RATE_TOLERANCE):
        motion = motion.resample(PRIOR_FPS)
    if motion.fps < PRIOR_FPS * (1 - _RATE_TOLERANCE):
        rate = f"{float(motion.fps):.4g} frames a second"
        notes = (*notes, f"measured at {rate}; mocap's values at {PRIOR_FPS} tell of quicker changes")
    return motion, notes
