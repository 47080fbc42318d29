"""Where the hips of the receiving body go: the giver's trajectory in scale, as high as legs and ground ask for."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mapctl import rotations
from mapctl.motion import Motion
from mapctl.numerics.easing import smootherstep
from mapctl.retarget.carry.character import FEET, HIP_JOINTS, TOES, RiggedCharacter
from mapctl.retarget.carry.holding import envelope, low_pass
from mapctl.retarget.stance import SIDES
from mapctl.skeleton import LIMBS, Skeleton

_FREE_EXTENSION = 0.985  # of the leg: a leg may be that straight, whatever the giver's is
MAX_EXTENSION = 0.9995
"""How straight a leg may be at most, of its length."""
_HIP_FIT_SECONDS = 0.06  # seconds over which the height of hips is smoothed
_HIP_DROP_SECONDS = 0.12  # seconds over which hips go down for a leg that is too short, and up again
_SMOOTH_SECONDS = 0.05  # seconds over which what hips carry is smoothed
# Of the leg's length, from where on a leg is so straight that the hips' height begins to matter to it, and does fully.
_STRAIGHT_SHARES = (0.93, 0.985)
# Of the leg's length, how far down a foot is from which the hips' height begins to matter to it, and matters fully.
_DOWN_SHARES = (0.5, 0.8)
_LEAST_SAY = 0.02  # of both legs together, below which the hips' height is left to the trajectory
_UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def transfer_root(
    own: Motion, giver: RiggedCharacter, body: RiggedCharacter, scale: float, raised: Float[Tensor, " frames"]
) -> Motion:
    """Put the giver's rotations on the body's bones. The middle between the thighs follows its trajectory in scale, as
    much higher as ankles, floor and `raised` (metres, by what the ground is kept higher than in scale) ask for."""
    to_thighs = body.leveled.offsets[HIP_JOINTS].mean(0) - scale * own.skeleton.offsets[HIP_JOINTS].mean(0)
    turns = own.joint_rotations()[:, 0]
    # The hips' rotation is noisy; what they carry at another distance is not to shake for it.
    aside = low_pass(rotations.rotate(turns, to_thighs.expand(own.num_frames, 3)), _SMOOTH_SECONDS * float(own.fps))
    ankle = _ankle_height(body.stance.standing_height, body.leveled)
    others = _ankle_height(giver.stance.flat_height, own.skeleton)
    rise = _UP * (ankle - scale * others + (1 - scale) * giver.stance.floor + raised)[:, None]
    return replace(own, skeleton=body.leveled, root_position=scale * own.root_position + rise - aside, source=None)


def _ankle_height(toe_height: Float[Tensor, "2"], leveled: Skeleton) -> Float[Tensor, ""]:
    """Return the height of the ankles over the floor while feet lie flat, metres, mean of both."""
    return (toe_height - leveled.offsets[TOES, 1]).mean()


def leg_extension(own: Motion) -> Float[Tensor, "frames 2"]:
    """Return how straight the giver's legs are: hip joint to ankle over both bones' length."""
    places = own.joint_positions()
    return (places[:, FEET] - places[:, HIP_JOINTS]).norm(dim=-1) / leg_bone_lengths(own.skeleton)


def leg_bone_lengths(skeleton: Skeleton) -> Float[Tensor, "2"]:
    """Return thigh and shin together, left and right, metres."""
    return torch.tensor([LIMBS[side + "Foot"].length(skeleton) for side in SIDES], dtype=torch.float64)


def fit_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Raise or lower hips smoothly until legs that reach the ankles' targets are as straight as the giver's.

    This has an inverse, so that a clip that goes to another body and back has its hips where they were.
    """
    short, down = _find_missing_length(moved, ankles, stretch.clamp(max=MAX_EXTENSION))
    begin, end = _DOWN_SHARES
    bent, straight = _STRAIGHT_SHARES
    say = smootherstep((stretch - bent) / (straight - bent)) * smootherstep((down - begin) / (end - begin))
    total = say.sum(dim=-1, keepdim=True)
    lower = (say * short).sum(dim=-1, keepdim=True) / (total + _LEAST_SAY)
    return _lower(moved, low_pass(lower, _HIP_FIT_SECONDS * float(moved.fps)))


def lower_hips(moved: Motion, ankles: Float[Tensor, "frames 2 3"], stretch: Float[Tensor, "frames 2"]) -> Motion:
    """Lower hips smoothly until legs reach the ankles' targets no straighter than the giver's, or than most."""
    short, down = _find_missing_length(moved, ankles, stretch.clamp(_FREE_EXTENSION, MAX_EXTENSION))
    # A leg that points sideways or up is not helped by lower hips.
    short = torch.where(down > _DOWN_SHARES[0], short.clamp_min(0), 0.0).amax(dim=-1, keepdim=True)
    return _lower(moved, envelope(short, _HIP_DROP_SECONDS, float(moved.fps)))


def _find_missing_length(
    moved: Motion, ankles: Float[Tensor, "frames 2 3"], extension: Float[Tensor, "frames 2"]
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, "frames 2"]]:
    """Return by how much the hips are too high for a leg of this extension to reach its ankle's target, metres, and how
    far down that is, of this leg's length."""
    to_ankles = ankles - moved.joint_positions()[:, HIP_JOINTS]
    most = leg_bone_lengths(moved.skeleton) * extension
    level, down = to_ankles[..., ::2].square().sum(-1), -to_ankles[..., 1]
    return down - (most.square() - level).clamp_min(0).sqrt(), down / most


def _lower(moved: Motion, dip: Float[Tensor, "frames 1"]) -> Motion:
    return replace(moved, root_position=moved.root_position - dip * _UP)
