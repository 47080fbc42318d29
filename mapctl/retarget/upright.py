"""Files whose world does not have Y up, as many rigs' have Z, put upright as `mapctl.retarget` sees them."""

from dataclasses import replace

from mapctl import retarget, rotations
from mapctl.errors import RequestError
from mapctl.motion import Motion
from mapctl.retarget.rigs import Rig

UNKNOWN_RIG_NOTE = "the rig is not known, and so not which way is up: taken as it is, with Y up"
"""Note on a motion that cannot be put upright."""


def put_upright(motion: Motion, rig: Rig | None = None) -> tuple[Motion, tuple[str, ...]]:
    """Put a motion on its own rig upright, with Y up; also return a note where the rig is not known.

    Unchanged where Y is up already, or nothing is known.
    """
    try:
        turn = retarget.identify_rig(motion.skeleton, rig, motion=motion).upright_quat_xyzw
    except RequestError:
        return motion, (UNKNOWN_RIG_NOTE,)
    if turn is None:
        return motion, ()
    every, local = turn.expand(motion.num_frames, 4), motion.local_quat_xyzw.clone()
    local[:, 0] = rotations.multiply(every, local[:, 0])
    return replace(motion, root_position=rotations.rotate(every, motion.root_position), local_quat_xyzw=local), ()
