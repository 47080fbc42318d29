"""Known corruptions of clean captures, on any rig, on which denoising is measured."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor

from controllers.benchmarks.shared.filters import apply_filter, design_butterworth
from mapctl import retarget, rotations
from mapctl.contacts import detect_contacts
from mapctl.errors import RequestError
from mapctl.kinematics import local_from_world
from mapctl.motion import Motion
from mapctl.recording.masks import Mask
from mapctl.retarget import from_canonical, to_canonical
from mapctl.skeleton import CANONICAL, LIMBS, TOES


@dataclass(frozen=True)
class CorruptedClip:
    """A corrupted capture."""

    motion: Motion
    """Motion on the rig of the clean one."""
    masks: tuple[Mask, ...] = ()
    """Masks that a user would give with it."""


CorruptionFunction = Callable[[Motion, torch.Generator], CorruptedClip]
"""Function that corrupts a clean motion."""


def add_noise(
    motion: Motion, generator: torch.Generator, *, degrees: float, centimetres: float, spikes: float = 0.01
) -> CorruptedClip:
    """Add normal noise to every angle of the joints that move and to the root position; spikes of 40 degrees."""
    angles = math.radians(degrees) * _sample_angle_noise(motion, generator)
    hit = torch.rand(angles.shape, generator=generator, dtype=torch.float64) < spikes
    angles = angles + hit * math.radians(40) * torch.sign(_sample_angle_noise(motion, generator))
    offset = _sample_position_noise(motion, generator) * centimetres / 100
    return CorruptedClip(_translate_body(_turn_moving_joints(motion, angles), offset))


def add_lasting_noise(
    motion: Motion, generator: torch.Generator, *, degrees: float, centimetres: float, seconds: float
) -> CorruptedClip:
    """Add coloured noise to the angles of the joints that move and to the root position: normal, of this standard
    deviation, and correlated over a time, as of markers that shift on the skin (a stationary first-order process).
    """
    keep = math.exp(-1 / (seconds * float(motion.fps)))
    angles = math.radians(degrees) * _make_lasting(_sample_angle_noise(motion, generator), keep)
    offset = centimetres / 100 * _make_lasting(_sample_position_noise(motion, generator), keep)
    return CorruptedClip(_translate_body(_turn_moving_joints(motion, angles), offset))


def filter_noisy(
    motion: Motion, generator: torch.Generator, *, degrees: float, centimetres: float, hertz: float
) -> CorruptedClip:
    """Add noise without spikes, and filter it away above a frequency, as capture software does before it exports:
    Butterworth, of fourth order, forward and backward.
    """
    noisy = add_noise(motion, generator, degrees=degrees, centimetres=centimetres, spikes=0.0).motion
    return CorruptedClip(apply_filter(noisy, design_butterworth(hertz, float(motion.fps))))


def perturb_positions(motion: Motion, generator: torch.Generator, *, centimetres: float) -> CorruptedClip:
    """Add noise to the joints' positions, as of markers: bones point from one noisy position to the next and keep their
    lengths; the hips' own position is noisy.
    """
    canonical, rigmap = to_canonical(motion)
    positions = canonical.joint_positions()
    perturbed = positions + centimetres / 100 * torch.randn(positions.shape, generator=generator, dtype=torch.float64)
    world = canonical.joint_rotations().clone()
    for joint in range(CANONICAL.num_joints):
        if below := CANONICAL.children(joint):
            child = below[0]
            turn = rotations.between_vectors(
                positions[:, child] - positions[:, joint], perturbed[:, child] - perturbed[:, joint]
            )
            world[:, joint] = rotations.multiply(turn, world[:, joint])
    local = rotations.make_sign_continuous(local_from_world(CANONICAL.parents, world))
    corrupted = replace(canonical, root_position=perturbed[:, 0], local_quat_xyzw=local)
    return CorruptedClip(from_canonical(corrupted, rigmap, motion))


def drop_joints(motion: Motion, generator: torch.Generator, *, share: float) -> CorruptedClip:
    """Drop a share of the joints in each frame: they are masked, and their rotations random."""
    corrupted = add_noise(motion, generator, degrees=1.0, centimetres=0.5, spikes=0.0).motion
    missing = torch.rand(motion.num_frames, motion.num_joints, generator=generator) < share
    masks = [Mask(motion.skeleton.names[joint], frame, frame + 1) for frame, joint in missing.nonzero().tolist()]
    return CorruptedClip(_randomise_rotations(corrupted, missing, generator), tuple(masks))


def drop_arm(motion: Motion, generator: torch.Generator, *, seconds: float) -> CorruptedClip:
    """Drop an arm for some seconds in the middle; slight noise on the rest."""
    corrupted = add_noise(motion, generator, degrees=1.0, centimetres=0.5, spikes=0.0).motion
    rigmap = retarget.identify_rig(motion.skeleton)
    length = min(round(seconds * float(motion.fps)), motion.num_frames // 2)
    start = (motion.num_frames - length) // 2
    limb = LIMBS["leftHand"]
    arm = [rigmap.joint_of[joint] for joint in (limb.upper, limb.lower, limb.end)]
    joints = [joint for joint in arm if joint is not None]
    missing = torch.zeros(motion.num_frames, motion.num_joints, dtype=torch.bool)
    missing[start : start + length, joints] = True
    masks = tuple(Mask(motion.skeleton.names[joint], start, start + length) for joint in joints)
    return CorruptedClip(_randomise_rotations(corrupted, missing, generator), masks)


def add_drift(motion: Motion, generator: torch.Generator, *, speed: float) -> CorruptedClip:
    """Make the body and its planted feet drift to and fro over the ground, m/s; slight noise."""
    corrupted = add_noise(motion, generator, degrees=1.0, centimetres=0.5, spikes=0.0).motion
    seconds = torch.arange(motion.num_frames, dtype=torch.float64) / float(motion.fps)
    swing = speed * 1.5 / math.pi * torch.sin(math.pi * seconds / 1.5)
    return CorruptedClip(_translate_body(corrupted, torch.stack([swing, 0 * swing, 0 * swing], dim=-1)))


CONDITIONS: Mapping[str, CorruptionFunction] = {
    **{
        f"{d:g} degrees, {0.4 * d:g} cm, 1 % spikes": partial(add_noise, degrees=d, centimetres=0.4 * d)
        for d in (1, 3, 5, 8)
    },
    "5 cm on every joint's place": partial(perturb_positions, centimetres=5.0),
    "5 degrees, 2 cm that last 0.1 s": partial(add_lasting_noise, degrees=5.0, centimetres=2.0, seconds=0.1),
    "5 degrees, 2 cm, filtered at 6 Hz": partial(filter_noisy, degrees=5.0, centimetres=2.0, hertz=6.0),
    "10 % of joints lost": partial(drop_joints, share=0.1),
    "30 % of joints lost": partial(drop_joints, share=0.3),
    "an arm lost for 2 s": partial(drop_arm, seconds=2.0),
    "body drifts by 20 cm/s": partial(add_drift, speed=0.2),
}
"""Corruptions by name, in the order of the table."""


def detect_true_contacts(motion: Motion) -> Tensor:
    """Detect contacts of the left and the right toe in a clean motion, at its own rate (frames, 2)."""
    canonical, _ = to_canonical(motion)
    toes = canonical.skeleton.indices(TOES)
    return detect_contacts(canonical.joint_positions()[:, toes], float(motion.fps))


def _sample_angle_noise(motion: Motion, generator: torch.Generator) -> Tensor:
    return torch.randn(motion.num_frames, motion.num_joints, 3, generator=generator, dtype=torch.float64)


def _sample_position_noise(motion: Motion, generator: torch.Generator) -> Tensor:
    return torch.randn(motion.num_frames, 3, generator=generator, dtype=torch.float64)


def _make_lasting(white: Tensor, keep: float) -> Tensor:
    """Correlate white noise of frames: each keeps a share of the one before, at the same deviation."""
    scaled = np.concatenate([white[:1].numpy(), math.sqrt(1 - keep * keep) * white[1:].numpy()])
    return torch.as_tensor(lfilter([1.0], [1.0, -keep], scaled, axis=0))


def _turn_moving_joints(motion: Motion, angles: Tensor) -> Motion:
    """Turn the joints that move at all by rotation vectors, radians."""
    moves = (motion.local_quat_xyzw != motion.local_quat_xyzw[:1]).any(dim=-1).any(dim=0)
    turns = rotations.from_rotation_vector(angles * moves[None, :, None])
    return replace(motion, local_quat_xyzw=rotations.multiply(motion.local_quat_xyzw, turns))


def _translate_body(motion: Motion, offset: Tensor) -> Motion:
    """Translate the travelling joint: the hips or the root."""
    hips = retarget.identify_rig(motion.skeleton).joint_of[0]
    if hips is None:
        raise RequestError("a rig without hips cannot be moved")
    if hips == 0 or hips not in motion.moving_offsets:
        return replace(motion, root_position=motion.root_position + offset)
    moving = {**motion.moving_offsets, hips: motion.moving_offsets[hips] + offset}
    return replace(motion, moving_offsets=moving)


def _randomise_rotations(motion: Motion, missing: Tensor, generator: torch.Generator) -> Motion:
    """Randomise the rotations of missing joints, so that reading them shows in the error."""
    wild = rotations.from_rotation_vector(_sample_angle_noise(motion, generator))
    return replace(motion, local_quat_xyzw=torch.where(missing[..., None], wild, motion.local_quat_xyzw))
