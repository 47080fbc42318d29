"""Made-up walks for the tests of scenes: the canonical skeleton swings its limbs and moves ahead."""

from dataclasses import replace
from fractions import Fraction

import torch

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL, Skeleton

HIPS_HEIGHT = 0.0219 + 0.3908 + 0.4099 + 0.1174
_SWING = {"leftUpperLeg": 0.5, "rightUpperLeg": -0.5, "leftUpperArm": -0.3, "rightUpperArm": 0.3}


def walk(frames: int = 12, *, fps: int = 12, speed: float = 1.0, skeleton: Skeleton = CANONICAL) -> Motion:
    """Along +Z from the origin; the first frame stands upright with straight legs."""
    time = torch.arange(frames, dtype=torch.float64) / fps
    angles = torch.zeros(frames, CANONICAL.num_joints, 3, dtype=torch.float64)
    for name, amplitude in _SWING.items():
        angles[:, CANONICAL.index(name), 0] = amplitude * torch.sin(2 * torch.pi * time)
    root = torch.stack([torch.zeros(frames), torch.full((frames,), HIPS_HEIGHT), speed * time], dim=-1).double()
    return Motion(skeleton, Fraction(fps), root, rotations.from_rotation_vector(angles))


def scaled(motion: Motion, factor: float) -> Motion:
    """The motion of someone `factor` times as large."""
    bones = motion.skeleton
    ends = {name: (x * factor, y * factor, z * factor) for name, (x, y, z) in bones.end_offsets.items()}
    larger = Skeleton(bones.names, bones.parents, bones.offsets * factor, ends)
    return replace(motion, skeleton=larger, root_position=motion.root_position * factor)


def renamed(motion: Motion, names: tuple[str, ...]) -> Motion:
    """The motion with other joint names."""
    bones = motion.skeleton
    ends = {names[bones.index(name)]: offset for name, offset in bones.end_offsets.items()}
    return replace(motion, skeleton=Skeleton(names, bones.parents, bones.offsets, ends))
