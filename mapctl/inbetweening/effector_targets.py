"""Target positions of effectors in frames that are otherwise free, and inverse kinematics that meets them."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mapctl.errors import RequestError
from mapctl.kinematics import inverse
from mapctl.motion import Motion
from mapctl.numerics import smooth_offsets
from mapctl.skeleton import CANONICAL, LIMBS

_MIN_REACH_SECONDS = 0.15  # seconds over which a limb goes to its target and back, at least
_REACH_ACCELERATION = 15.0  # m/s^2 at which it goes farther
_NEGLIGIBLE = 1e-12  # metres


@dataclass(frozen=True, eq=False)
class EffectorTargets:
    """Target positions, by frame and canonical joint; limbs bend to those of `LIMBS`."""

    places: Float[Tensor, "frames joints 3"]
    """World positions, metres; anything finite where there is no target."""
    wanted: Bool[Tensor, "frames joints"]
    """Whether a joint has a target in a frame."""

    def shown(self, seconds: Float[Tensor, " shown"], *, fps: float) -> "EffectorTargets":
        """Return the targets at other, increasing times: each is moved to the time nearest to its own."""
        nearest = find_nearest_times(len(self.places), seconds, fps=fps)
        joints = self.places.shape[1]
        positions, wanted = self.places.new_zeros(len(seconds), joints, 3), self.wanted.new_zeros(len(seconds), joints)
        for frame, joint in self.wanted.nonzero().tolist():
            positions[nearest[frame], joint] = self.places[frame, joint]
            wanted[nearest[frame], joint] = True
        return EffectorTargets(positions, wanted)


def find_nearest_times(frames: int, seconds: Float[Tensor, " shown"], *, fps: float) -> Int[Tensor, " frames"]:
    """Find for each of so many frames which of other, increasing times is the nearest."""
    own = torch.arange(frames, dtype=seconds.dtype) / fps
    after = torch.searchsorted(seconds, own).clamp(max=len(seconds) - 1)
    before = (after - 1).clamp_min(0)
    return torch.where((seconds[before] - own).abs() <= (seconds[after] - own).abs(), before, after)


def check_limbs(targets: EffectorTargets) -> None:
    """Raise RequestError unless only effectors of limbs have targets."""
    wanted = [CANONICAL.names[joint] for joint in targets.wanted.any(dim=0).nonzero()[:, 0].tolist()]
    other = [name for name in wanted if name not in LIMBS]
    if other:
        raise RequestError(f"effector targets are for {', '.join(LIMBS)}; {other[0]} has none")


def compute_target_errors(
    positions: Float[Tensor, "frames joints 3"], targets: EffectorTargets
) -> Float[Tensor, " frames"]:
    """Compute the largest distance of a joint to its target, by frame, metres."""
    distances = (positions - targets.places).norm(dim=-1)
    return (distances * targets.wanted).amax(dim=1)


def reach_effector_targets(motion: Motion, targets: EffectorTargets, free: Bool[Tensor, " frames"]) -> Motion:
    """Bend limbs of a canonical motion to their targets, if these are in reach; they go there and back smoothly within
    frames that are `free`. RequestError for targets of joints that are no effector."""
    check_limbs(targets)
    for limb in LIMBS.values():
        wanted = targets.wanted[:, limb.end] & free
        if not bool(wanted.any()):
            continue
        positions = motion.joint_positions().clone()
        errors = torch.where(wanted[:, None], targets.places[:, limb.end] - positions[:, limb.end], 0.0)
        seconds = max(_MIN_REACH_SECONDS, math.sqrt(float(errors.norm(dim=-1).max()) / _REACH_ACCELERATION))
        offset = smooth_offsets.interpolate_offsets(errors, wanted | ~free, seconds=seconds, fps=float(motion.fps))
        offset = torch.where(free[:, None], offset, 0.0)
        positions[:, limb.end] += offset
        turning = torch.zeros(positions.shape[:2], dtype=torch.bool)
        turning[:, [limb.upper, limb.lower]] = (offset.norm(dim=-1) > _NEGLIGIBLE)[:, None]
        quats = inverse.solve_inverse_kinematics(
            positions, motion.local_quat_xyzw, motion.skeleton, free=turning, limbs=(limb,)
        )
        motion = replace(motion, local_quat_xyzw=torch.where(turning[..., None], quats, motion.local_quat_xyzw))
    return motion
