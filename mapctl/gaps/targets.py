"""Places that joints are to be at in frames that are otherwise free, and meeting them to the hair."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mapctl import inverse_kinematics, rotations
from mapctl.errors import RequestError
from mapctl.gaps import second_differences
from mapctl.motion import Motion
from mapctl.skeleton import CANONICAL

LIMBS = {
    "leftHand": ("leftUpperArm", "leftLowerArm"), "rightHand": ("rightUpperArm", "rightLowerArm"),
    "leftFoot": ("leftUpperLeg", "leftLowerLeg"), "rightFoot": ("rightUpperLeg", "rightLowerLeg"),
}  # fmt: skip
"""Ends of limbs, and the two joints that bring them to a place."""
_REACH = 0.15  # seconds over which a limb goes to its place and back
_FIRM = 1e9  # how much more a place counts than smoothness
_SIDE = 0.003  # metres
_STRAIGHT = 1e-4  # metres that a limb is kept from being straight


@dataclass(frozen=True, eq=False)
class Targets:
    """Wanted places, by frame and canonical joint."""

    places: Float[Tensor, "frames joints 3"]
    """World, metres; anything finite where no place is wanted."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a place is."""

    def __post_init__(self):
        other = self.wanted.any(dim=0)
        names = [name for name, some in zip(CANONICAL.names, other.tolist(), strict=True) if some and name not in LIMBS]
        if names:
            raise RequestError(f"places are for {', '.join(LIMBS)}; {names[0]} has none")

    def shown(self, seconds: Float[Tensor, " shown"], *, fps: float) -> "Targets":
        """At other moments, rising: every wanted place is one of the moment that is nearest to its own."""
        own = torch.arange(len(self.places), dtype=seconds.dtype) / fps
        after = torch.searchsorted(seconds, own).clamp(max=len(seconds) - 1)
        before = (after - 1).clamp_min(0)
        nearest = torch.where((seconds[before] - own).abs() <= (seconds[after] - own).abs(), before, after)
        joints = self.places.shape[1]
        places, wanted = self.places.new_zeros(len(seconds), joints, 3), self.wanted.new_zeros(len(seconds), joints)
        for frame, joint in self.wanted.nonzero().tolist():
            places[nearest[frame], joint] = self.places[frame, joint]
            wanted[nearest[frame], joint] = True
        return Targets(places, wanted)


def missed(places: Float[Tensor, "frames joints 3"], targets: Targets) -> Float[Tensor, " frames"]:
    """By frame, how far the worst joint is from its place, metres."""
    away = (places - targets.places).norm(dim=-1)
    return (away * targets.wanted).amax(dim=1)


def reached(motion: Motion, targets: Targets, free: Bool[Tensor, " frames"]) -> Motion:
    """A canonical motion with limbs bent so that they are at their places, if these are in reach; they go there and
    back smoothly within frames that are `free`.
    """
    for name, (upper, lower) in LIMBS.items():
        end = CANONICAL.index(name)
        wanted = targets.wanted[:, end] & free
        if not bool(wanted.any()):
            continue
        places = motion.joint_positions()
        away = torch.where(wanted[:, None], targets.places[:, end] - places[:, end], 0.0)
        offset = torch.where(free[:, None], _smooth(away, wanted | ~free, fps=float(motion.fps)), 0.0)
        chain = [CANONICAL.index(joint) for joint in (upper, lower)]
        motion = _bent(motion, places, chain[0], chain[1], end, offset)
    return motion


def _bent(
    motion: Motion, places: Float[Tensor, "frames joints 3"], upper: int, lower: int, end: int,
    offset: Float[Tensor, "frames 3"],
) -> Motion:  # fmt: skip
    """Two bones turned so that the end is where it was, plus the offset, as far as they reach; in their own plane."""
    root, knee, foot = places[:, upper], places[:, lower], places[:, end]
    first, second = (knee - root).norm(dim=-1), (foot - knee).norm(dim=-1)
    way = foot + offset - root
    low = (first - second).abs() + _STRAIGHT
    far = way.norm(dim=-1).clamp_min(1e-9)
    reach = torch.minimum(torch.maximum(far, low), first + second - _STRAIGHT)
    axis = way / far[:, None]
    # A straight limb does not show its plane: knees then go forward and elbows back.
    usual = torch.tensor([0.0, 0.0, 1.0 if "Leg" in motion.skeleton.names[upper] else -1.0], dtype=places.dtype)
    side = knee - root + _SIDE * rotations.rotate(motion.joint_rotations()[:, upper], usual.expand(len(places), 3))
    across = side - (side * axis).sum(-1, keepdim=True) * axis
    along = (first.square() - second.square() + reach.square()) / (2 * reach)
    height = (first.square() - along.square()).clamp_min(0).sqrt()
    bent = root + along[:, None] * axis + height[:, None] * torch.nn.functional.normalize(across, dim=-1)
    wanted = places.clone()
    wanted[:, lower], wanted[:, end] = bent, root + reach[:, None] * axis
    moved = offset.norm(dim=-1) > 1e-12
    turning = torch.zeros(wanted.shape[:2], dtype=torch.bool)
    turning[:, [upper, lower]] = moved[:, None]
    quats = inverse_kinematics.solve(wanted, motion.local_quat_xyzw, motion.skeleton, free=turning)
    return replace(motion, local_quat_xyzw=torch.where(turning[..., None], quats, motion.local_quat_xyzw))


def _smooth(
    values: Float[Tensor, "frames 3"], firm: Bool[Tensor, " frames"], *, fps: float
) -> Float[Tensor, "frames 3"]:
    """The smoothest offsets, nothing far away, that are the values in the frames that are firm."""
    count = len(values)
    if count < 3:
        return torch.where(firm[:, None], values, 0.0)
    weight = second_differences.fading(_REACH, fps) + _FIRM * firm.double().numpy()
    right = _FIRM * (values * firm[:, None]).double().numpy()
    return torch.as_tensor(second_differences.solved(right, weight, start=0, frames=count)).to(values)
