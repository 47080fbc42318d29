"""Legs of canonical motions: heights of hips at which they reach, and knees bent so that they do."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics import gaussian
from mapctl.numerics.easing import smootherstep
from mapctl.retarget.character import FEET, HIP_JOINTS, LEGS, TOES, limb_lengths
from mapctl.skeleton import Skeleton

FREE_EXTENSION = 0.985  # of the leg: a leg may be that straight, whatever the source's is
MAX_EXTENSION = 0.9995  # of the leg: how straight one may be at most
_HIP_FIT_SECONDS = 0.06  # seconds over which the height of hips is smoothed
_HIP_DROP_SECONDS = 0.12  # seconds over which hips go down for a leg that is too short, and up again
# Of the leg's length, from where on a leg is so straight that the hips' height begins to matter to it, and does fully.
_STRAIGHT_SHARES = (0.93, 0.985)
# Of the leg's length, how far down a foot is from which the hips' height begins to matter to it, and matters fully.
_DOWN_SHARES = (0.5, 0.8)
_LEAST_INFLUENCE = 0.02  # of both legs together, below which the hips' height is left to the trajectory


def locate_feet(motion: Motion) -> tuple[Float[Tensor, "frames 2 3"], Float[Tensor, "frames 2 4"]]:
    """Return the toe joints, world, metres, and the rotations of the feet."""
    return motion.joint_positions()[:, TOES].double(), motion.joint_rotations()[:, FEET].double()


def find_ankles(
    skeleton: Skeleton, toes: Float[Tensor, "frames 2 3"], turns: Float[Tensor, "frames 2 4"]
) -> Float[Tensor, "frames 2 3"]:
    """Find the ankles of feet with toe joints at positions, metres, and rotations in the world."""
    offsets = skeleton.offsets[TOES].to(toes)
    return toes - rotations.rotate(turns, offsets.expand_as(toes))


def lower_by(motion: Motion, lower: Float[Tensor, " frames"]) -> Motion:
    """Lower a motion by so many metres."""
    return replace(motion, root_position=motion.root_position - torch.stack([0 * lower, lower, 0 * lower], dim=-1))


def find_missing_length(
    moved: Motion, ankles: Float[Tensor, "frames 2 3"], extension: Float[Tensor, "*#frames 2"]
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, "frames 2"]]:
    """Return by how much the hips are too high for a leg of this extension to reach its ankle's target, metres, and how
    far down that is, of this leg's length."""
    to_ankles = ankles - moved.joint_positions()[:, HIP_JOINTS]
    most = limb_lengths(moved.skeleton, LEGS) * extension
    level, down = to_ankles[..., ::2].square().sum(-1), -to_ankles[..., 1]
    return down - (most.square() - level).clamp_min(0).sqrt(), down / most


def fit_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Raise or lower hips smoothly until legs that reach the ankles' targets are as straight as the source's.

    This has an inverse, so that a clip that goes to another body and back has its hips where they were.
    """
    short, down = find_missing_length(moved, ankles, stretch.clamp(max=MAX_EXTENSION))
    begin, end = _DOWN_SHARES
    bent, straight = _STRAIGHT_SHARES
    influence = smootherstep((stretch - bent) / (straight - bent)) * smootherstep((down - begin) / (end - begin))
    total = influence.sum(dim=-1, keepdim=True)
    lower = (influence * short).sum(dim=-1, keepdim=True) / (total + _LEAST_INFLUENCE)
    dip = gaussian.smooth(lower, _HIP_FIT_SECONDS * float(moved.fps))
    return lower_by(moved, dip[:, 0])


def lower_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Lower hips smoothly until legs reach the ankles' targets no straighter than the source's, or than most."""
    short, down = find_missing_length(moved, ankles, stretch.clamp(FREE_EXTENSION, MAX_EXTENSION))
    # A leg that points sideways or up is not helped by lower hips.
    short = torch.where(down > _DOWN_SHARES[0], short.clamp_min(0), 0.0).amax(dim=-1, keepdim=True)
    dip = gaussian.envelope(short, _HIP_DROP_SECONDS, float(moved.fps))
    return lower_by(moved, dip[:, 0])


def bend_legs(motion: Motion, ankles: Float[Tensor, "frames 2 3"], turns: Float[Tensor, "frames 2 4"]) -> Motion:
    """Bend legs so that ankles are at positions, metres, and feet have these rotations, world; thighs turn as little as
    it takes."""
    positions, world, quats = motion.joint_positions(), motion.joint_rotations(), motion.local_quat_xyzw.clone()
    offsets, to_ankles = motion.skeleton.offsets.to(positions), ankles - positions[:, HIP_JOINTS]
    for foot, limb in enumerate(LEGS):
        bend = rotations.to_rotation_vector(quats[:, limb.lower])
        bend[:, 0] = bend[:, 0].clamp_min(0)  # a leg that is straight bends forward again, not backward
        quats[:, limb.lower] = rotations.from_rotation_vector(bend)
        turn, bent = inverse.reach(limb, world[:, limb.upper], quats[:, limb.lower], to_ankles[:, foot], offsets)
        quats[:, limb.upper] = rotations.multiply(rotations.inverse(world[:, 0]), turn)
        quats[:, limb.lower] = bent
        quats[:, limb.end] = rotations.multiply(rotations.inverse(rotations.multiply(turn, bent)), turns[:, foot])
    return replace(motion, local_quat_xyzw=rotations.make_sign_continuous(quats))
