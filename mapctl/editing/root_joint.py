"""The root joint of a rig: where it is and which way it faces, and one added above the hips."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.formats import bvh
from mapctl.formats.character import add_root_to_character
from mapctl.motion import Motion
from mapctl.skeleton import Skeleton

_NAMES = ("root", "motion_root")


def set_root_track(
    motion: Motion, place: Float[Tensor, "frames 3"], turn_xyzw: Float[Tensor, "frames 4"], kept: Sequence[int]
) -> Motion:
    """Return a motion whose joint 0 has this position (metres) and rotation (xyzw). Those of its children that are
    `kept` stay where they are in the world, the others go with it."""
    places, world = motion.joint_positions(), motion.joint_rotations()
    local, moving = motion.local_quat_xyzw.clone(), dict(motion.moving_offsets)
    local[:, 0], back = turn_xyzw, rotations.inverse(turn_xyzw)
    for child in kept:
        local[:, child] = rotations.multiply(back, world[:, child])
        moving[child] = rotations.rotate(back, places[:, child] - place)
    return replace(
        motion,
        root_position=place,
        local_quat_xyzw=rotations.make_sign_continuous(local),
        moving_offsets=dict(sorted(moving.items())),
    )


def add_root(motion: Motion) -> Motion:
    """Return the same motion with a still joint above its first one, at the origin of the world; the file's layout, or
    its character (glTF, VRM), has it too."""
    old, frames = motion.skeleton, motion.num_frames
    name = next(name for name in (*_NAMES, *(f"root_{n}" for n in range(old.num_joints + 1))) if name not in old.names)
    offsets = torch.cat([old.offsets.new_zeros(1, 3), old.offsets])
    offsets[1] = motion.root_position[0]
    skeleton = Skeleton((name, *old.names), (-1, *(parent + 1 for parent in old.parents)), offsets, old.end_offsets)
    still = motion.local_quat_xyzw.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(frames, 1, 4)
    moving = {joint + 1: track for joint, track in motion.moving_offsets.items()}
    return Motion(
        skeleton,
        motion.fps,
        torch.zeros_like(motion.root_position),
        torch.cat([still, motion.local_quat_xyzw], dim=1),
        {1: motion.root_position, **moving},
        bvh.add_root_to_layout(motion.source, name) or add_root_to_character(motion.source, name),
        motion.licence,
    )
