"""Bones of mocap that is compared with generated motion."""

from dataclasses import replace

from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

_SAME_BONES = 1e-3  # metres by which joints of one body differ between rigs at most


def put_on_generated_bones(motion: Motion) -> Motion:
    """Return a motion on canonical joints with the bones of generated motion, where its own are within 1 mm of them.

    Rigs round their bones: a few hundredths of a millimetre are enough for networks to tell which of two files a trunk
    is of. Another body keeps its bones, since its feet would slide on these.
    """
    apart = (motion.skeleton.offsets - CANONICAL.offsets).norm(dim=-1).max()
    return replace(motion, skeleton=CANONICAL) if float(apart) < _SAME_BONES else motion
