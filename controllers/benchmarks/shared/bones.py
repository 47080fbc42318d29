"""Bones of mocap that is compared with generated motion."""

from dataclasses import replace

from mapctl.features import PRIOR_FPS
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, leg_length

_SAME_BONES = 1e-3  # metres by which joints of one body differ between rigs at most


def put_on_generated_bones(motion: Motion) -> Motion:
    """Return a motion on canonical joints with the bones of generated motion, where its own are within 1 mm of them.

    Rigs round their bones: a few hundredths of a millimetre are enough for networks to tell which of two files a trunk
    is of. Another body keeps its bones, since its feet would slide on these.
    """
    apart = (motion.skeleton.offsets - CANONICAL.offsets).norm(dim=-1).max()
    return replace(motion, skeleton=CANONICAL) if float(apart) < _SAME_BONES else motion


def scale_to_canonical_bones(motion: Motion) -> Motion:
    """Return a canonical motion at the prior's rate on the canonical skeleton, scaled by leg length."""
    motion = motion.resample(PRIOR_FPS)
    scale = leg_length(motion.skeleton) / leg_length(CANONICAL)
    return Motion(CANONICAL, motion.fps, motion.root_position / scale, motion.local_quat_xyzw)


def slice_middle(motion: Motion, frames: int) -> Motion:
    """Return so many frames from the middle of a motion that has them."""
    start = (motion.num_frames - frames) // 2
    return motion.slice(start, start + frames)
